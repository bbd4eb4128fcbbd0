"""Localizes one image of a robot after the other: its prior, the call, and what is published of the answer."""

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mapless.answers import LocalizationResult, PriorCheck, Rejected
from mapless.client import Client
from mapless.depth import DepthImage
from mapless.errors import MaplessError
from mapless.geometry import Array, RigidTransform, rotation_angle_deg
from mapless.groups import SequenceFrame, SequenceLocalization
from mapless.priors import PosePrior, Priors
from mapless.requests import read_mask

from .cameras import RosCamera
from .depths import RosDepth
from .localizer_options import LocalizerOptions
from .poses import pose_of_body, stamp_ns_of, time_of, transform_from_pose

Lookup = Callable[[str, str, int], RigidTransform]
"""Function that gives target_from_source of two frames at a stamp, nanoseconds, 0 for the latest; LookupError if tf
does not know it."""

_Answer = LocalizationResult | SequenceLocalization | Rejected

LOCALIZED, NOT_LOCALIZED, FAILED = "OK", "WARN", "ERROR"
"""Levels of an outcome, named as those of diagnostic_msgs/DiagnosticStatus."""

UNSTATED_SIGMA_M, UNSTATED_SIGMA_RAD = 1.0, 0.2
"""Standard deviations for an initial pose's variances that are 0, as rviz leaves those of height, roll and pitch."""

LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.02, 0.01
"""Added to a guess that odometry has moved: clocks and extrinsics are never exact."""

ODOMETRY_DRIFT = 0.1
"""Standard deviation of odometry, as a share of the way and the angle: wheels slip."""

SPEED_M_S, TURN_RAD_S, GUESS_LIFE_S = 1.5, 1.5, 5.0
"""Without odometry: how fast a robot may have moved since, and how long its last pose says anything."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of an image.

    Attributes:
        stamp_ns: when it was taken.
        level: `LOCALIZED`, `NOT_LOCALIZED` or `FAILED`.
        message: for a person; begins with the reason of a rejection or an error.
        values: for programs and people, by name.
        frame: the frame whose pose it is.
        map_from_body: its pose in the map; None if not localized.
        covariance: (6, 6) of that pose, ROS's order, metres and radians about the map's fixed axes.
        tf_edge: child frame and map_from_child to publish on tf: those of the odometry, or without odometry those of
            the body; None if not localized, or if the odometry is unknown at that time.
        map_frame: frame of the map, which is the world of the scene that the image is of; empty if not localized.
    """

    stamp_ns: int
    level: str
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    frame: str = ""
    map_from_body: RigidTransform | None = None
    covariance: Array | None = None
    tf_edge: tuple[str, RigidTransform] | None = None
    map_frame: str = ""


@dataclass(frozen=True, eq=False)
class _Guess:
    """A pose of the body at a time, in the world of a scene, with the odometry at that time."""

    scene: str
    map_from_body: RigidTransform
    covariance: Array
    stamp_ns: int
    odom_from_body: RigidTransform | None


class Localizer:
    """Localizes images of a robot. `guess` may be called from another thread than the rest."""

    def __init__(self, client: Client, options: LocalizerOptions, lookup: Lookup) -> None:
        self._client = client
        self._options = options
        self._mask = read_mask(options.mask)
        self._uncertainty = options.uncertainty
        self._lookup = lookup
        self._lock = threading.Lock()
        self._guess: _Guess | None = None
        self._used: _Guess | None = None
        self._last_ns: int | None = None
        self._recent: deque[SequenceFrame] = deque(maxlen=options.sequence_length)

    def is_due(self, stamp_ns: int) -> bool:
        """Whether an image of this time is due by the rate; also if time has jumped back."""
        if not self._options.rate_hz:
            return False
        since_ns = None if self._last_ns is None else stamp_ns - self._last_ns
        # A little early is nearer to the rate than a whole image late; cameras jitter.
        return since_ns is None or since_ns < 0 or since_ns >= 0.95e9 / self._options.rate_hz

    def guess(self, message: Any, now_ns: int) -> None:
        """Uses a geometry_msgs/PoseWithCovarianceStamped of the base in the map, as of /initialpose, as a prior.

        Its frame says in which of several scenes. ValueError if it is given in another frame, or its numbers are not a
        pose.
        """
        frame = message.header.frame_id.lstrip("/")
        scene = self._options.scene_of(frame)
        if scene is None:
            raise ValueError(f"the initial pose is given in frame {frame!r}, not in {self._options.map_frame!r}")
        map_from_base = transform_from_pose(message.pose.pose)
        covariance = np.array(message.pose.covariance, float).reshape(6, 6)
        if not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
            raise ValueError("the covariance of the initial pose is none: not finite, or a variance below 0")
        unstated = np.repeat([UNSTATED_SIGMA_M, UNSTATED_SIGMA_RAD], 3) ** 2
        covariance = covariance + np.diag(np.where(np.diag(covariance) == 0, unstated, 0.0))
        stamp_ns = stamp_ns_of(message.header.stamp) or now_ns
        base = self._options.base_frame
        # rviz stamps with now, which odometry may not have reached yet: then its latest is as good.
        odom_from_base = self._odometry(base, stamp_ns) or self._odometry(base, 0)
        with self._lock:
            self._guess = _Guess(scene, map_from_base, covariance, stamp_ns, odom_from_base)

    def localize(self, message: Any, camera: RosCamera, find_depth: Callable[[int], RosDepth] | None = None) -> Outcome:
        """Localizes a sensor_msgs/Image or CompressedImage; a failure is an outcome, too.

        `find_depth`, of `Depths`, gives the depth of a photograph by its stamp. Without a usable one the photograph is
        localized alone, and the outcome's value `depth` says why.
        """
        stamp_ns = stamp_ns_of(message.header.stamp)
        if self._last_ns is not None and stamp_ns < self._last_ns:
            self._recent.clear()
        self._last_ns = stamp_ns
        camera_frame = message.header.frame_id.lstrip("/")
        body = self._options.base_frame or camera_frame
        try:
            body_from_camera = self._lookup(body, camera_frame, stamp_ns) if body != camera_frame else None
            extrinsics = body_from_camera or RigidTransform.identity()
            odom_from_body = self._odometry(body, stamp_ns)
            priors = Priors(pose=self._prior(stamp_ns, odom_from_body, extrinsics))
            photo = camera.photo(message)
            depth, about_depth = self._depth(stamp_ns, camera_frame, camera, find_depth)
            coverage, timeout_s = self._options.coverage, self._options.timeout_s
            answer: _Answer = self._client.localize(
                photo,
                camera.camera,
                self._options.scene,
                scenes=self._options.scenes,
                group=self._options.group,
                prior_scene=self._used.scene if self._used is not None and priors.pose is not None else "",
                priors=priors,
                coverage=coverage,
                capture_time=time_of(stamp_ns),
                mask=self._mask,
                intrinsics_uncertainty=self._uncertainty,
                depth=depth,
                allow_adoption=self._options.allow_adoption,
                timeout_s=timeout_s,
            )
            if self._options.sequence_length and odom_from_body is not None:
                tracked = odom_from_body.compose(extrinsics)
                # The last answer as a prior of several would be counted several times.
                own = Priors() if self._options.use_last_pose else priors
                frame = SequenceFrame(
                    photo,
                    camera.camera,
                    tracked,
                    time_of(stamp_ns),
                    priors=own,
                    mask=self._mask,
                    intrinsics_uncertainty=self._uncertainty,
                )
                self._recent.append(replace(frame, depth=depth))
                # Each image of a sequence was offered as a reference by its own call.
                if isinstance(answer, Rejected) and len(self._recent) > 1:
                    together = self._client.localize_sequence(
                        list(self._recent), self._options.scene, coverage=coverage, timeout_s=timeout_s
                    )
                    answer = together if isinstance(together, SequenceLocalization) else answer
        except LookupError as error:
            return Outcome(stamp_ns, FAILED, f"tf: {error}", frame=body)
        except (MaplessError, ValueError) as error:
            if isinstance(error, MaplessError) and error.field == "prior_scene":  # of which the guess was given
                with self._lock:
                    self._guess = None if self._guess is self._used else self._guess
            return Outcome(stamp_ns, FAILED, str(error), frame=body)
        outcome = self._outcome(answer, stamp_ns, body, extrinsics, odom_from_body)
        return replace(outcome, values={**outcome.values, **about_depth})

    def _depth(
        self, stamp_ns: int, camera_frame: str, camera: RosCamera, find: Callable[[int], RosDepth] | None
    ) -> tuple[DepthImage | None, dict[str, str]]:
        """The depth of a photograph, and what diagnostics say of it."""
        if find is None:
            return None, {}
        try:
            found = find(stamp_ns)
            is_same = found.frame == camera_frame
            pose = None if is_same else self._lookup(camera_frame, found.frame, stamp_ns)
            return found.image(camera, pose), {"depth": "sent"}
        except (LookupError, ValueError) as error:
            return None, {"depth": f"none: {error}"}

    def _outcome(
        self,
        answer: _Answer,
        stamp_ns: int,
        body: str,
        body_from_camera: RigidTransform,
        odom_from_body: RigidTransform | None,
    ) -> Outcome:
        values = _values(answer)
        if isinstance(answer, Rejected):
            return Outcome(stamp_ns, NOT_LOCALIZED, f"{answer.reason}: {answer.message}", values, body)
        if answer.arbitrary_unit:
            text = "the scene's unit of length is arbitrary: its poses are none of a robot"
            return Outcome(stamp_ns, FAILED, text, values, body)
        if answer.covariance is None or not np.isfinite(answer.covariance).all():
            return Outcome(stamp_ns, NOT_LOCALIZED, "a pose without covariance is not published", values, body)
        message, map_from_camera, checks = "localized", answer.world_from_camera, _prior_checks(answer)
        if isinstance(map_from_camera, tuple):
            message, map_from_camera = f"localized by the last {len(map_from_camera)} images", map_from_camera[-1]
        pose, covariance = pose_of_body(map_from_camera, answer.covariance, body_from_camera)
        with self._lock:
            if self._guess is self._used:  # and not one that has come meanwhile
                scene = "" if self._options.scene or isinstance(answer, SequenceLocalization) else answer.scene
                last = _Guess(scene, pose, covariance, stamp_ns, odom_from_body)
                self._guess = last if self._options.use_last_pose else None
        if any(check.conflict for check in checks):
            message += "; the photograph contradicts the initial or last pose, which was not used"
        edge: tuple[str, RigidTransform] | None = (body, pose)
        if self._options.odom_frame:
            edge = None
            if odom_from_body is not None:
                edge = (self._options.odom_frame, pose.compose(odom_from_body.inverse()))
            else:
                message += f"; tf does not know {self._options.odom_frame} > {body} at that time"
        map_frame = self._options.map_frame_of("" if isinstance(answer, SequenceLocalization) else answer.scene)
        return Outcome(stamp_ns, LOCALIZED, message, values, body, pose, covariance, edge, map_frame)

    def _odometry(self, body: str, stamp_ns: int) -> RigidTransform | None:
        """The pose odom_from_body; None without odometry, or if it is unknown at this time."""
        if not self._options.odom_frame:
            return None
        try:
            return self._lookup(self._options.odom_frame, body, stamp_ns)
        except (LookupError, ValueError):  # odometry that is lost has null poses
            return None

    def _prior(
        self, stamp_ns: int, odom_from_body: RigidTransform | None, body_from_camera: RigidTransform
    ) -> PosePrior | None:
        """The prior of the camera: the guess, moved by odometry until now, with the covariance that this adds."""
        with self._lock:
            guess = self._used = self._guess
        if guess is None:
            return None
        if odom_from_body is not None and guess.odom_from_body is not None:
            moved = guess.odom_from_body.inverse().compose(odom_from_body)
            way_m, turn_rad = math.hypot(*moved.translation), math.radians(rotation_angle_deg(moved.rotation))
            sigmas = (LEAST_SIGMA_M + ODOMETRY_DRIFT * way_m, LEAST_SIGMA_RAD + ODOMETRY_DRIFT * turn_rad)
        else:
            moved, since_s = RigidTransform.identity(), abs(stamp_ns - guess.stamp_ns) / 1e9
            if since_s > GUESS_LIFE_S:
                return None
            sigmas = (LEAST_SIGMA_M + SPEED_M_S * since_s, LEAST_SIGMA_RAD + TURN_RAD_S * since_s)
        # An error of the guess's direction is one of the position, the farther the body has moved since.
        pose, covariance = pose_of_body(guess.map_from_body, guess.covariance, moved.inverse())
        covariance = covariance + np.diag(np.repeat(sigmas, 3) ** 2)
        return PosePrior(*pose_of_body(pose, covariance, body_from_camera.inverse()))


def _prior_checks(answer: LocalizationResult | SequenceLocalization) -> tuple[PriorCheck, ...]:
    return answer.images[-1].prior_checks if isinstance(answer, SequenceLocalization) else answer.prior_checks


def _values(answer: _Answer) -> dict[str, str]:
    """The values of an answer for diagnostics; for a sequence, those of its newest image."""
    about = answer.images[-1].diagnostics if isinstance(answer, SequenceLocalization) else answer.diagnostics
    values = {"request_id": about.request_id, "server_s": f"{about.total_s:.3f}", "queue_s": f"{about.queue_s:.3f}"}
    if not isinstance(answer, SequenceLocalization) and about.searched_scene_count > 1:
        values["scene"] = answer.scene.rpartition("/")[2]
    values["references"] = " ".join(it.name.rpartition("/")[2] for it in about.references)
    if isinstance(answer, Rejected):
        values["reason"] = answer.reason
        if answer.hint is not None:
            values |= {"stage": answer.hint.stage, "advice": answer.hint.advice, "hint": answer.hint.message}
        return values
    values |= {"inliers": str(answer.inlier_count), "matches": str(answer.match_count)}
    if isinstance(answer, SequenceLocalization):
        values |= {"images": str(len(answer.images)), "jumps": str(len(answer.jumps))}
    if about.adoption:
        values["adoption"] = about.adoption
    if about.depth_check is not None:
        values["depth_check"] = str(about.depth_check)
    if answer.trust is not None:
        values["trust"] = f"{answer.trust:.3f}"
    if answer.accuracy is not None:
        values["position_95_m"] = f"{answer.accuracy.position_95_m:.4f}"
        values["rotation_95_deg"] = f"{answer.accuracy.rotation_95_deg:.4f}"
        values["calibration"] = answer.accuracy.calibration
    for check in _prior_checks(answer):
        values["prior"] = "contradicted" if check.conflict else "used" if check.used else "agrees, and adds nothing"
    return values
