"""Measures everything and reports it."""

from pathlib import Path

from mapless_server.observability.provenance import cpu_model
from mapless_server.serve.signals import terminable
from mapless_server.settings import available_cores, load_settings
from mapless_tools.evaluate.plan import EvaluationOptions
from mapless_tools.evaluate.run import Evaluation, evaluate
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.output_files import write_json
from mapless_tools.progress import labelled, progress_bars
from mapless_tools.usage import UsageError, usage_errors

from .report import KITCHEN, OTHER_FOLDERS, SCENES, BenchResult, as_json, markdown, measure_latency

OUTPUT = Path("bench-output/bench.json")
QUICK_QUERIES = 6
COLD_STARTS = 5


def bench(data: Path, quick: bool) -> None:
    """Measures a folder of scenes, prints Markdown and writes `OUTPUT`; UsageError for a wrong folder or setting."""
    folders = [*dict.fromkeys(scene.folder for scene in SCENES), *OTHER_FOLDERS]
    absent = [folder for folder in folders if not (data / folder / "cameras.json").is_file()]
    if len(absent) == len(folders):
        raise UsageError(f"{data} holds none of the scenes: {', '.join(folders)}")
    with usage_errors():
        settings = load_settings({}).settings
        datasets = {folder: read_folder(data / folder) for folder in folders if folder not in absent}
    query_count = QUICK_QUERIES if quick else None
    OUTPUT.parent.mkdir(exist_ok=True)

    with terminable(), progress_bars() as progress:

        def measure(folder: str, references: int | None) -> Evaluation:
            options = EvaluationOptions(reference_count=references, query_count=query_count)
            label = folder if references is None else f"{folder}, {references} references"
            return evaluate(datasets[folder], options, settings, labelled(progress, label))

        scenes = [(scene, measure(scene.folder, scene.references)) for scene in SCENES if scene.folder in datasets]
        others = [measure(folder, None) for folder in OTHER_FOLDERS if folder in datasets]
        latency = None
        if KITCHEN in datasets:
            cold_count = 2 if quick else COLD_STARTS
            own = labelled(progress, "latency")
            latency = measure_latency(datasets[KITCHEN], settings, query_count, cold_count, own)
    machine = f"{cpu_model()}, {available_cores()} cores"
    result = BenchResult(machine, scenes, others, latency, absent, quick)
    print("\n".join(markdown(result)))
    write_json(OUTPUT, as_json(result))
