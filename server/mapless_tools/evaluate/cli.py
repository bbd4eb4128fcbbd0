"""The flags of `mapless-server evaluate`. Imports what it needs when it runs, so that --help answers at once."""

from pathlib import Path
from typing import Annotated, Any

import typer

from mapless_tools.connection import Connection, with_flags
from mapless_tools.ingest.command import FORMAT_NAMES

OUTPUT = Path("evaluation-output")


@with_flags
def evaluate_command(
    folder: Annotated[
        Path,
        typer.Argument(
            help="A scene or the folder of a benchmark's scenes (7-Scenes, 12-Scenes, Cambridge Landmarks), or a "
            "folder with images/ and cameras.json."
        ),
    ],
    layout: Annotated[
        str,
        typer.Option(
            help="How it lies on the disk: auto, 7scenes, 12scenes, cambridge or cameras; with --calibrate also "
            f"another one of {FORMAT_NAMES}."
        ),
    ] = "auto",
    protocol: Annotated[
        str | None, typer.Option(help="dense, sparse or both: dense,sparse. Default: both, for benchmarks.")
    ] = None,
    sparse: Annotated[
        str | None,
        typer.Option(help="Numbers of references: 30,20,10,5. Default: the paper's, which are 60,50,40,30 outdoors."),
    ] = None,
    variants: Annotated[
        str, typer.Option("--variants", "--variant", help="Forms of the method: coarse,no_structure,full,best, or all.")
    ] = "best",
    scales: Annotated[
        str,
        typer.Option(
            "--scales",
            "--scale",
            help="Metric scale: two_stage,triangulation,trajectory, or all. Those after the first are run with the "
            "variant full if it is wanted, else with the first.",
        ),
    ] = "two_stage",
    k: Annotated[int, typer.Option(help="References that a query is given.")] = 10,
    stride: Annotated[int, typer.Option(help="Dense: every so many-th training frame is a reference.")] = 1,
    max_queries: Annotated[
        int | None, typer.Option(help="Queries of a scene, evenly spread; default: all. The report says so.")
    ] = None,
    choose: Annotated[
        str,
        typer.Option(
            help="What chooses a query's references: retrieval (the server's), matches (feature matches with all), "
            "given (all there are)."
        ),
    ] = "retrieval",
    pairs: Annotated[
        Path | None,
        typer.Option(help="References of each query as hloc writes them, a file or a folder with SCENE.txt for each."),
    ] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(help="SfM pseudo ground truth instead of the original poses, for 7scenes, 12scenes.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help=f"Folder of the report; what it holds is not measured again. Default: {OUTPUT}, for benchmarks."
        ),
    ] = None,
    partial: Annotated[
        bool, typer.Option("--partial", help="Leave out images that are missing or damaged; the report names them.")
    ] = False,
    worst: Annotated[int, typer.Option(help="Queries of each scene that the report shows as pictures.")] = 4,
    references: Annotated[
        int | None,
        typer.Option(help="cameras.json: references, evenly spread over the frames; default: leave one out."),
    ] = None,
    queries: Annotated[
        int | None, typer.Option(help="cameras.json: queries; default: 40, or every frame when one is left out.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="cameras.json: file to write the figures to.")] = None,
    calibrate: Annotated[
        str | None,
        typer.Option(
            metavar="SCENE",
            help="Id of a stored scene, in whose world the folder's poses are: its answers are measured, and the "
            "factors of their radii are stored with it.",
        ),
    ] = None,
    *,
    connection: Connection,
) -> None:
    """Measure accuracy and latency on photographs with known poses, through a server of its own.

    Benchmarks are measured as in the paper, dense and sparse, with its figures beside; a long evaluation that is
    interrupted goes on where it ended. A folder with cameras.json is measured by leaving one out, or with --references,
    unless --protocol or --output asks for the same report.

    With --calibrate the server is the one at --address, or is started on the store of the settings; the photographs
    are localized in a scene that is there, which has none of them, and its answers are calibrated from then on. Only
    --layout, --variant, --k, --queries and --json go with it.
    """
    from mapless_tools.usage import failures_end_command

    with failures_end_command():
        if calibrate is not None:
            others: dict[str, object] = {
                "protocol": protocol,
                "sparse": sparse,
                "max_queries": max_queries,
                "pairs": pairs,
            }
            others |= {"ground_truth": ground_truth, "output": output, "partial": partial, "references": references}
            others |= {"scales": scales != "two_stage", "stride": stride != 1, "choose": choose != "retrieval"}
            _refuse("without --calibrate", **others, worst=worst != 4)
            from .command import calibrate_scene

            calibrate_scene(folder, layout, calibrate, connection, json, query_count=queries, k=k, variant=variants)
            return
        _refuse("with --calibrate", **vars(connection))
        if _is_own_folder(folder, layout) and protocol is None and output is None:
            benchmarks = {"sparse": sparse, "max_queries": max_queries, "pairs": pairs, "ground_truth": ground_truth}
            _refuse("with --protocol or --output", **benchmarks, partial=partial)
            from .command import evaluate_folder

            options: dict[str, Any] = {"reference_count": references, "query_count": queries, "k": k}
            evaluate_folder(folder, json, **options, variant=variants, scale_strategy=scales)
            return
        own = {"references": references, "queries": queries, "json": json}
        _refuse("for a folder with cameras.json, and without --protocol or --output", **own)
        from .command import evaluate_benchmarks
        from .plan import PROTOCOLS, SCALES, VARIANTS

        default = "sparse" if _is_own_folder(folder, layout) else ",".join(PROTOCOLS)
        complete = evaluate_benchmarks(
            folder,
            output or OUTPUT,
            pairs=pairs,
            ground_truth=ground_truth,
            partial=partial,
            worst=worst,
            layout=layout,
            protocols=_words(protocol or default, PROTOCOLS),
            sparse=_numbers(sparse),
            variants=_words(variants, ("best", *(v for v in VARIANTS if v != "best"))),
            scales=_words(scales, ("two_stage", *(s for s in SCALES if s != "two_stage"))),
            k=k,
            stride=stride,
            max_queries=max_queries,
            choice=choose,
        )
    raise typer.Exit(0 if complete else 1)


def _is_own_folder(folder: Path, layout: str) -> bool:
    return layout in ("auto", "cameras") and (folder / "cameras.json").is_file()


def _refuse(only: str, **flags: object) -> None:
    from mapless_tools.usage import UsageError

    given = [f"--{name.replace('_', '-')}" for name, value in flags.items() if value not in (None, False, "")]
    if given:
        raise UsageError(f"{', '.join(given)}: only {only}")


def _words(text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    return known if text == "all" else tuple(word.strip() for word in text.split(",") if word.strip())


def _numbers(text: str | None) -> tuple[int, ...]:
    from mapless_tools.usage import UsageError

    try:
        return tuple(int(word) for word in (text or "").split(",") if word.strip())
    except ValueError:
        raise UsageError(f"sparse takes whole numbers, 30,20,10,5, not {text!r}") from None
