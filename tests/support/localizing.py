"""A planted scene, pipelines over it, and their answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.method.coarse import Outcome, Request
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.features.views import Features, PosedView, Reconstruction, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import DoubtOptions, LocalizeOptions
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection, RejectionReason
from support.fake_network import FakeNetwork, FakeNetworkOptions
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for, unit_rows

SCENE = make_scene(random_for("localize"), SceneOptions(point_count=400, reference_count=5))


MATCHER = Matcher()


ROUGH = FakeNetworkOptions(depth_noise_m=0.03, pose_noise_m=0.01, pose_noise_deg=0.2)


JUDGED = ["uncertainty", "judge"]


LATER_STAGES = ["structure", "match", "pnp"]


@dataclass(frozen=True)
class ChangedNetwork:
    """A network whose reconstruction is changed."""

    network: FakeNetwork
    change: Callable[[Reconstruction], Reconstruction]
    name: str = "changed"
    weights_sha256: str = ""
    uses_correspondences: bool = False
    is_batched: bool = True

    def close(self) -> None:
        self.network.close()

    def bucket(self, query: View, references: Sequence[PosedView]) -> str:
        return str(self.network.bucket(query, references))

    def reconstruct_many(self, requests: Sequence[Request]) -> list[Outcome | Exception]:
        return [self.change(self.network.reconstruct(request.query, request.references)) for request in requests]


def pipeline_of(backend: str, scene: SyntheticScene = SCENE, options: FakeNetworkOptions | None = None) -> Pipeline:
    reconstructor = GeometricReconstructor() if backend == "geometric" else FakeNetwork(scene, 0, options)
    return Pipeline(reconstructor, MATCHER if scene is SCENE else Matcher())


def answer_of(
    pipeline: Pipeline,
    options: LocalizeOptions | None = None,
    query: View | None = None,
    doubt: DoubtOptions = DoubtOptions(),  # noqa: B008  frozen
) -> Answer:
    return localize(query or SCENE.query, SCENE.references, pipeline, options or LocalizeOptions(), doubt=doubt)


def pose_of(answer: Answer) -> Localization:
    assert isinstance(answer.outcome, Localization), answer.outcome
    return answer.outcome


def reason_of(answer: Answer) -> RejectionReason:
    assert isinstance(answer.outcome, Rejection), answer.outcome
    return answer.outcome.reason


def without_meaning(view: View) -> View:
    """The same keypoints, but their descriptors are like nothing else."""
    random = random_for("without meaning")
    descriptors = unit_rows(random.standard_normal(view.features.descriptors.shape)).astype(np.float32)
    return replace(view, features=replace(view.features, descriptors=descriptors))


def fewer_features(seed: int) -> View:
    """The query, but that every tenth of its features is not found."""
    f = SCENE.query.features
    kept = random_for("fewer features", seed).random(len(f)) < 0.9
    return replace(SCENE.query, features=Features(f.keypoints[kept], f.descriptors[kept], f.sizes_px[kept]))


def weak_below(inliers: int) -> DoubtOptions:
    """Poses with fewer inliers are doubtful, and no others."""
    return DoubtOptions(0.0, np.inf, inliers)


def blinded(reconstruction: Reconstruction) -> Reconstruction:
    """As of a network whose activations overflowed."""
    nowhere = RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan))
    return Reconstruction(
        replace(reconstruction.query, local_from_camera=nowhere),
        tuple(
            replace(r, local_from_camera=nowhere, point_map=np.full_like(r.point_map, np.nan))
            for r in reconstruction.references
        ),
    )


class Cancelled(Exception):
    """The error that a check raises."""
