"""COLMAP beside mapless: `python -m research.colmap FOLDER_OF_SCENES RESULTS` prints Markdown.

COLMAP localizes the photographs that `mapless-server evaluate` does, each with all references that the scene has there:
SIFT, matches of all pairs, points triangulated from the references' given poses and intrinsics, and the pose of the
query from its matches with references that have points. The query has no part in the points, and neither poses nor
intrinsics of references change. RESULTS gets a file for each scene and number of references, with the fields of
`mapless-server evaluate --json`; what is there is not measured again.
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mapless.geometry import Array, RigidTransform
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.evaluate.metrics import QueryResult, pose_error, trajectory_radius
from mapless_tools.evaluate.plan import MAX_K, EvaluationOptions, split_frames
from mapless_tools.evaluate.references import PlannedQuery
from mapless_tools.evaluate.report import SCALE_FREE, format_length, format_rotation, to_json
from mapless_tools.evaluate.run import Evaluation
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.formats.colmap.cameras import from_camera
from mapless_tools.output_files import markdown_table, whole_file, write_json

from .places import KITCHEN, RIGHT_DEG, RIGHT_M, RIGHT_SHARE

SCENES = (
    "fountain-P11",
    "herz-jesus-P8",
    KITCHEN,
    "tum-fr3-office",
    "kitti-drive-a",
    "fox-portrait",
    "reichstag-internet",
    "euroc-v101-drone",
    "office-lockers",
    "meeting-room",
    "studio-flat",
    "statue-of-liberty-internet",
    "rendered-room",
)
LONG_SIDE_PX, KEYPOINTS = 1024, 2048
"""Those of mapless. COLMAP counts places, of which each has a keypoint for every orientation."""
SPARSE = (5, 10, 20)
DENSE: Mapping[str, int | None] = {KITCHEN: 30}
"""References where leaving one out of the scene would say nothing: neighbours in a video are next to one another."""
FEWEST: Mapping[str, tuple[int, ...]] = {KITCHEN: (3,)}
MIN_QUERIES = 3
MIN_INLIERS = 6
"""A pose with fewer is none: nearly all with 4 or 5 were wrong. COLMAP's mapper wants 30 and would lose many."""
RULES = (
    "Medians, p90 and recall are over all queries; one that was not localized counts as infinitely wrong.",
    "References of a query: all of the scene.",
    "Latency: processor time of the query's features, of its matches with all references (mean of the scene's pairs, "
    "times their number) and of its pose; building the map is not in it.",
)


@dataclass(frozen=True)
class Case:
    """A scene and how many of its frames are references; None leaves one out."""

    scene: str
    references: int | None

    @property
    def file_name(self) -> str:
        """Name of the file with its results."""
        return f"{self.scene}.json" if self.references is None else f"{self.scene}-{self.references}.json"


def cases_of(scene: str, frame_count: int) -> Iterator[Case]:
    """Dense, and at those numbers of references that leave enough queries."""
    dense = DENSE.get(scene)
    yield Case(scene, dense)
    for count in (*reversed(SPARSE), *FEWEST.get(scene, ())):
        if count < frame_count - MIN_QUERIES:
            _, queries = split_frames(range(frame_count), EvaluationOptions(count))
            if len(queries) >= MIN_QUERIES:
                yield Case(scene, count)


def queries_of(dataset: Dataset, case: Case) -> list[PlannedQuery]:
    """Those of `mapless-server evaluate`."""
    references, queries = split_frames(dataset.frames, EvaluationOptions(case.references))
    return [PlannedQuery(query, tuple(frame for frame in references if frame is not query)) for query in queries]


class SceneDatabase:
    """COLMAP's database of a scene, put into `folder`: features of frames, and matches of pairs.

    Images are named by their paths from `root`. Each of at most so many orientations of a place makes a keypoint.
    """

    def __init__(self, root: Path, folder: Path, orientations: int = 2) -> None:
        self._root, self._folder, self._orientations = root, folder, orientations
        self._path = folder / "database.db"
        self._feature_s: dict[str, float] = {}
        self._ids: dict[str, int] = {}
        self._matched: set[frozenset[str]] = set()
        self._matching_s = 0.0

    def add_features(self, frames: Sequence[Frame]) -> None:
        """Finds the keypoints of those frames that have none yet."""
        options = pycolmap.FeatureExtractionOptions(num_threads=1, max_image_size=LONG_SIDE_PX)
        options.sift.max_num_features = KEYPOINTS
        options.sift.max_num_orientations = self._orientations
        for frame in frames:
            if frame.name in self._ids:
                continue
            camera = from_camera(1, frame.camera)
            reader = pycolmap.ImageReaderOptions(
                camera_model=camera.model, camera_params=",".join(repr(float(it)) for it in camera.parameters)
            )
            start_s = time.process_time()
            pycolmap.extract_features(
                self._path, self._root, [self._name(frame)], pycolmap.CameraMode.PER_IMAGE, reader, options
            )
            self._feature_s[frame.name] = time.process_time() - start_s
            with pycolmap.Database.open(self._path) as database:
                image = database.read_image_with_name(self._name(frame))
            if image is None:
                raise ValueError(f"COLMAP could not read {frame.image_path}")
            self._ids[frame.name] = image.image_id

    def add_matches(self, pairs: Sequence[tuple[Frame, Frame]]) -> None:
        """Matches and verifies those pairs that have not been yet."""
        wanted = {frozenset((a.name, b.name)): f"{self._name(a)} {self._name(b)}\n" for a, b in pairs}
        wanted = {pair: line for pair, line in wanted.items() if pair not in self._matched}
        if not wanted:
            return
        (self._folder / "pairs.txt").write_text("".join(wanted.values()), encoding="utf-8")
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = 0
        start_s = time.process_time()
        pycolmap.match_image_pairs(
            self._path,
            pycolmap.FeatureMatchingOptions(num_threads=1),
            pycolmap.ImportedPairingOptions(match_list_path=self._folder / "pairs.txt"),
            verification,
        )
        self._matching_s += time.process_time() - start_s
        self._matched |= wanted.keys()

    def triangulated(self, references: Sequence[Frame]) -> pycolmap.Reconstruction:
        """A map of references at their given poses; their points are adjusted, nothing else."""
        scene = pycolmap.Reconstruction()
        with pycolmap.Database.open(self._path) as database:
            for frame in references:
                image = database.read_image(self._ids[frame.name])
                camera_from_world = pycolmap.Rigid3d(frame.world_from_camera.inverse().matrix()[:3])
                scene.add_camera_with_trivial_rig(database.read_camera(image.camera_id))
                scene.add_image_with_trivial_frame(
                    pycolmap.Image(image.name, np.zeros((0, 2)), image.camera_id, image.image_id), camera_from_world
                )
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=1, random_seed=0, extract_colors=False, image_names=[self._name(it) for it in references]
        )
        # The query would make a third view of many points that two references see; it is not there when the map is.
        options.triangulation.ignore_two_view_tracks = False
        output = self._folder / "map"
        output.mkdir(exist_ok=True)
        return pycolmap.triangulate_points(scene, self._path, self._root, output, True, options)

    def localize(self, query: PlannedQuery, scene: pycolmap.Reconstruction) -> QueryResult:
        """The pose of a query from its matches with the points of a map."""
        frame = query.frame
        start_s = time.process_time()
        x_in_image, x_in_world = self._correspondences(query, scene)
        found = None
        with pycolmap.Database.open(self._path) as database:
            camera = database.read_camera(database.read_image(self._ids[frame.name]).camera_id)
        if len(x_in_image) >= MIN_INLIERS:
            estimation = pycolmap.AbsolutePoseEstimationOptions()
            estimation.ransac.random_seed = 0
            found = pycolmap.estimate_and_refine_absolute_pose(x_in_image, x_in_world, camera, estimation)
        pose_s = time.process_time() - start_s
        inliers = 0 if found is None else int(found["num_inliers"])
        error = (math.inf, math.inf)
        if found is not None and inliers >= MIN_INLIERS:
            camera_from_world = np.vstack([found["cam_from_world"].matrix(), [0, 0, 0, 1]])
            error = pose_error(frame.world_from_camera, RigidTransform.from_matrix(camera_from_world).inverse())
        matching_s = self._matching_s / len(self._matched) * len(query.references)
        stages = {"features": self._feature_s[frame.name], "match": matching_s, "pnp": pose_s}
        centres = np.array([it.world_from_camera.translation for it in query.references])
        distances = np.linalg.norm(centres - frame.world_from_camera.translation, axis=1)
        lost = math.isinf(error[0])
        return QueryResult(
            name=frame.name,
            references=tuple(it.name for it in query.references),
            translation_error=error[0],
            rotation_error_deg=error[1],
            reference_distance=float(np.median(distances)),
            inlier_count=inliers,
            match_count=len(x_in_image),
            rejection="FEW_INLIERS" if lost else "",
            message=f"{inliers} of {len(x_in_image)} matches with points fit a pose" if lost else "",
            latency_ms=1000 * sum(stages.values()),
            stage_ms={stage: 1000 * seconds for stage, seconds in stages.items()},
            backend="colmap",
            features=f"sift-{KEYPOINTS}-{LONG_SIDE_PX}px",
        )

    def _correspondences(self, query: PlannedQuery, scene: pycolmap.Reconstruction) -> tuple[Array, Array]:
        """Keypoints of the query (N, 2) and the points (N, 3) of keypoints that they match, each pair once."""
        query_id = self._ids[query.frame.name]
        pairs: dict[tuple[int, int], None] = {}
        with pycolmap.Database.open(self._path) as database:
            keypoints = database.read_keypoints(query_id)[:, :2].astype(float)
            for frame in query.references:
                points = scene.image(self._ids[frame.name]).points2D
                if not database.exists_matches(query_id, self._ids[frame.name]):
                    continue
                # Unverified, as hloc takes them: the pose verifies them, and pairs of under 15 inliers count as well.
                for i, j in database.read_matches(query_id, self._ids[frame.name]).tolist():
                    if points[j].has_point3D():
                        pairs[i, points[j].point3D_id] = None
        x_in_image = np.array([keypoints[i] for i, _ in pairs]).reshape(-1, 2)
        return x_in_image, np.array([scene.point3D(point).xyz for _, point in pairs]).reshape(-1, 3)

    def _name(self, frame: Frame) -> str:
        return Path(os.path.relpath(frame.image_path, self._root)).as_posix()


def measure(dataset: Dataset, case: Case, database: SceneDatabase) -> dict[str, Any]:
    """The results of a case, with the fields of `mapless-server evaluate --json`."""
    queries = queries_of(dataset, case)
    references = list(dict.fromkeys(frame for query in queries for frame in query.references))
    database.add_features(list(dict.fromkeys((*references, *(query.frame for query in queries)))))
    among_references = [(a, b) for i, a in enumerate(references) for b in references[:i]]
    database.add_matches([*among_references, *((query.frame, it) for query in queries for it in query.references)])
    results, map_s = [], []
    scene: pycolmap.Reconstruction | None = None
    for query in queries:
        if scene is None or case.references is None:
            start_s = time.process_time()
            scene = database.triangulated(query.references)
            map_s.append(time.process_time() - start_s)
        results.append(database.localize(query, scene))
    radius = trajectory_radius(np.array([it.world_from_camera.translation for it in references]))
    given = len(queries[0].references)
    options = EvaluationOptions(case.references, k=min(given, MAX_K))
    evaluation = Evaluation(dataset, options, len(references), radius, tuple(results))
    rules = [*RULES] if dataset.metric else [*RULES, SCALE_FREE]
    changed = {"variant": "", "scale": "", "version": f"COLMAP {pycolmap.__version__}", "k": given, "rules": rules}
    return {**to_json(evaluation), **changed, "triangulation_s": float(np.mean(map_s))}


def cells_of(content: Mapping[str, Any], distances: Mapping[str, float]) -> list[str]:
    """Cells of a result file: how many are localized, how many of these wrongly, medians, and seconds of a query.

    Wrong ones are off by more than `RIGHT_M`, or `RIGHT_SHARE` of the distance to the references (by the query's name)
    where the unit is arbitrary, or by more than `RIGHT_DEG`. A median is infinite where half of the queries are lost.
    """
    metric = content["metric"]
    unit = "m" if metric else "units"
    median = content["median_translation_m"] if metric else content["relative"]["median_translation_units"]
    found = [it for it in content["per_query"] if it["localized"]]
    wrong = [
        it[f"translation_{unit}"] > (RIGHT_M if metric else RIGHT_SHARE * distances[it["name"]])
        or it["rotation_deg"] > RIGHT_DEG
        for it in found
    ]
    length, degrees = (math.inf if it is None else it for it in (median, content["median_rotation_deg"]))
    medians = f"{format_length(length, metric)} / {format_rotation(degrees)}"
    return [str(len(found)), str(sum(wrong)), medians, f"{content['latency_ms']['p50'] / 1000:.2f}"]


def table(cases: Sequence[Case], results: Path, mapless: Path | None) -> Iterator[str]:
    """COLMAP's figures and, where its files are in a folder, those of mapless."""
    systems = ["COLMAP"] if mapless is None else ["COLMAP", "mapless"]
    names = ("localized", "wrong", "median", "s")
    head = ["scene", "references", "queries", *(f"{it}: {name}" for it in systems for name in names)]
    rows = []
    for case in cases:
        file = results / case.file_name
        if not file.is_file():
            continue
        colmap = json.loads(file.read_text(encoding="utf-8"))
        unit = "m" if colmap["metric"] else "units"
        distances = {it["name"]: it[f"reference_distance_{unit}"] for it in colmap["per_query"]}
        cells = cells_of(colmap, distances)
        if mapless is not None:
            cells += _mapless_texts(mapless / case.file_name, distances)
        references = "leave one out" if case.references is None else str(case.references)
        rows.append([case.scene, references, str(colmap["queries"]), *cells])
    yield from markdown_table(" | ".join(head), rows)


def _mapless_texts(file: Path, distances: Mapping[str, float]) -> list[str]:
    if not file.is_file():
        return [""] * 4
    content = json.loads(file.read_text(encoding="utf-8"))
    if {it["name"] for it in content["per_query"]} != distances.keys():
        raise ValueError(f"{file} has other queries than COLMAP's results of this case")
    return cells_of(content, distances)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("results", type=Path, help="folder of COLMAP's results")
    parser.add_argument("--mapless", type=Path, help="folder of `mapless-server evaluate --json` with the same names")
    parser.add_argument("--only", action="append", help="scenes; all if not given")
    parser.add_argument("--orientations", type=int, default=2, help="of a place, at most; 2 is COLMAP's default")
    parser.add_argument("--list", action="store_true", help="print folder, file and references of each case and end")
    arguments = parser.parse_args()
    folders = [arguments.data / scene for scene in arguments.only or SCENES]
    datasets = [read_folder(folder) for folder in folders]
    cases = [[*cases_of(folder.name, len(it.frames))] for folder, it in zip(folders, datasets, strict=True)]
    if arguments.list:
        for folder, of_scene in zip(folders, cases, strict=True):
            for case in of_scene:
                print(folder, case.file_name, case.references or "dense")
        return
    arguments.results.mkdir(parents=True, exist_ok=True)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    for folder, dataset, of_scene in zip(folders, datasets, cases, strict=True):
        with tempfile.TemporaryDirectory(prefix="mapless-colmap-") as temporary:
            database = SceneDatabase(folder, Path(temporary), arguments.orientations)
            for case in of_scene:
                file = arguments.results / case.file_name
                if not file.is_file():
                    print(f"{case.file_name} ...", file=sys.stderr, flush=True)
                    with whole_file(file) as partial:
                        write_json(partial, measure(dataset, case, database))
    for line in table([case for of_scene in cases for case in of_scene], arguments.results, arguments.mapless):
        print(line)


if __name__ == "__main__":
    main()
