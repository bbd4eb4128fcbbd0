"""Sources to a folder of photographs with poses, as the commands do it."""

from collections.abc import Sequence
from pathlib import Path

from mapless_server.serve.signals import terminable
from mapless_tools.progress import progress_bars

from .output import REPORT, printed, write_folder
from .run import ReconstructOptions, prepare, reconstruct
from .sources import SourceOptions, read_sources


def reconstruct_into(sources: Sequence[Path], out: Path, wanted: SourceOptions, options: ReconstructOptions) -> None:
    """Writes the folder `out` and prints what is in it; ValueError says why there are no poses."""
    with terminable(), progress_bars() as progress:
        work = prepare(sources, out)
        pictures = read_sources(sources, work / "pictures", wanted, progress)
        result = reconstruct(pictures, work, options, progress)
        write_folder(result, work, out, progress)
    print("\n".join([*printed(result), f"they are in {out}; look at {out / REPORT}"]))
