"""Decides which localized photographs become references, and when references are retired.

The pose of an adopted reference is that of its photograph localized a second time, from surveyed references alone. So
no such pose rests on an adopted reference, errors do not add up however often a place changes, and what vouches for it
can be counted. A third localization, of what the second did not explain, must not find another place:
else a thing that was moved, as a poster, would take a photograph of another place along.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_angle_deg
from mapless.scenes import AdoptionPolicy
from mapless_server.bounds import check_bounds
from mapless_server.security import Principal, Role
from mapless_server.store.records import Standing

DAY_US = 24 * 3600 * 1_000_000
MOST_WITNESSES = 100
"""Contradictions whose days and holders are remembered."""


@dataclass(frozen=True)
class AdoptionOptions:
    """Bounds of adoption that are the same for all scenes.

    `first_usefulness` and `places` are policy. `research.renovation` and `research.adoption_attack` measure what all of
    them together lead to.

    Attributes:
        min_matches: least matches with surveyed references that agree with the pose from them.
        min_vouchers, voucher_matches: least surveyed references with at least so many such matches.
        min_rivals: matches with surveyed references that agree on another pose, with which a photograph is not adopted.
        min_novelty: least share of a photograph's keypoints that are not near a match of its answer.
        explained_share: what is so near a match is explained by it, share of the image's longer side.
        first_usefulness: most usefulness of a new reference, so that it cannot at once push out one that proved useful.
        remembered: photographs that medians and means remember.
        least_photographs: least photographs of a place with too small a share of surveyed support before it is said to
            need a new survey; they come on so many days, and from so many holders, as contradictions.
        photographs_a_day: most photographs that count for a place on one day, so that several days are remembered.
        places: most places that one photograph counts for: those whose references are around its viewpoint.
        same_viewpoint_deg, same_viewpoint_share: a photograph that looks in a direction so near to a reference's, from
            so near, a share of the distance to what it shows, should show what that shows.
        contradicting_share: such a photograph contradicts the reference where it has a smaller share of its matches
            with it, and agrees where it has twice that.
        contradictions, contradicting_days, contradicting_others: contradictions in a row after which a reference is
            retired, least days on which they came, and least that came from others than the holder of a token with
            most of them. Each holder counts once a day. A holder who may change the scene could delete the reference,
            and needs no other.

    Evidence: adoption-matches, adoption-rivals, adoption-novelty, adoption-contradictions, adoption-witnesses,
    adoption-outdated.
    """

    min_matches: int = 30
    min_vouchers: int = 2
    voucher_matches: int = 8
    min_rivals: int = 20
    min_novelty: float = 0.2
    explained_share: float = 0.04
    first_usefulness: float = 0.2
    remembered: int = 10
    least_photographs: int = 5
    photographs_a_day: int = 3
    places: int = 4
    same_viewpoint_deg: float = 15.0
    same_viewpoint_share: float = 0.15
    contradicting_share: float = 0.05
    contradictions: int = 5
    contradicting_days: int = 3
    contradicting_others: int = 2

    def __post_init__(self) -> None:
        counts = "min_matches min_vouchers voucher_matches min_rivals remembered least_photographs photographs_a_day"
        check_bounds(self, f"{counts} places contradictions contradicting_days contradicting_others", at_least=1)
        check_bounds(self, "min_novelty first_usefulness contradicting_share", at_least=0, at_most=1)
        check_bounds(self, "explained_share same_viewpoint_share", above=0, at_most=1)
        check_bounds(self, "same_viewpoint_deg", above=0, at_most=180)


class Refusal(str, Enum):
    """Reasons why a photograph whose caller allows it is not adopted."""

    UNCERTAIN = "uncertain"
    """Its trust or radius does not reach the scene's policy, or the answer is not refined."""
    UNSUPPORTED = "unsupported"
    """Surveyed references alone do not localize it with that certainty, by enough matches, or with another camera."""
    LITTLE_SURVEYED = "little_surveyed"
    """They support too small a share of its matches."""
    DISAGREES = "disagrees"
    """They place it elsewhere than its answer."""
    ELSEWHERE = "elsewhere"
    """The part that they do not explain shows another place, or as many matches as may vouch agree on another pose."""
    NOTHING_NEW = "nothing_new"
    """It shows nothing that the references lack."""
    PLACE_FULL = "place_full"
    """Its place has as many adopted references as it may, all more useful, or one of its caller since today."""
    CHANGED = "changed"
    """The scene has changed meanwhile: it adopts no more, what vouches for it is gone, or another server was first."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """An answer, as far as adoption is concerned.

    Attributes:
        world_from_camera: the pose.
        position_68_m, position_95_m, rotation_68_deg, rotation_95_deg: its reported radii.
        trust: its trust.
        inlier_count: matches that agree with it.
        inliers_of: the same for each reference that has some, by id.
        covariance: (6, 6) that the radii are of, order x y z rx ry rz, metres and radians, fixed world axes.
    """

    world_from_camera: RigidTransform
    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float
    trust: float
    inlier_count: int
    inliers_of: Mapping[str, int]
    covariance: Array

    def agrees_with(self, other: "Evidence") -> bool:
        """Whether both are one pose, within the hypotenuses of their 95 % radii, doubled: they share matches."""
        ours, theirs = self.world_from_camera, other.world_from_camera
        distance = float(np.linalg.norm(ours.translation - theirs.translation))
        angle_deg = rotation_angle_deg(ours.rotation.T @ theirs.rotation)
        near = 2 * math.hypot(self.position_95_m, other.position_95_m)
        return distance <= near and angle_deg <= 2 * math.hypot(self.rotation_95_deg, other.rotation_95_deg)


def is_certain(policy: AdoptionPolicy, found: Evidence) -> bool:
    """Whether an answer reaches the trust and the radius of a scene's policy."""
    return found.trust >= policy.min_trust and found.position_68_m <= policy.radius_m


def camera_error_m(camera: Camera, focal_share: float, distance_m: float) -> float:
    """How far a camera displaces what its corners show at this distance, by one standard deviation of its focal length.

    `focal_share` is that, as a share of the focal length.
    """
    corner_px = math.hypot(camera.width_px, camera.height_px) / 2
    return focal_share * distance_m * corner_px / camera.focal_x_px


def surveyed_share(size_px: tuple[int, int], inliers_px: Array, surveyed_px: Array, options: AdoptionOptions) -> float:
    """Share of what an answer explains of its photograph that surveyed references explain, too, 0 to 1.

    By area: adopted references add matches where nothing has changed as well, and so would lower a share of matches.

    Args:
        size_px: width and height of the photograph.
        inliers_px: (M, 2) the answer's matches.
        surveyed_px: (S, 2) those of the answer from surveyed references alone; S is 0 without one.
        options: what is near a match.
    """
    by_all, by_survey = (explained(size_px, it, options) for it in (inliers_px, surveyed_px))
    return float((by_all & by_survey).sum() / max(by_all.sum(), 1))


def refusal(
    policy: AdoptionPolicy, answered: Evidence, surveyed: Evidence | None, share: float, options: AdoptionOptions
) -> Refusal | None:
    """Why a photograph is not adopted by its answer, and that from surveyed references alone; None if it may be.

    `share` is that of `surveyed_share`.
    """
    if not is_certain(policy, answered):
        return Refusal.UNCERTAIN
    if surveyed is None or not is_certain(policy, surveyed):
        return Refusal.UNSUPPORTED
    vouchers = sum(it >= options.voucher_matches for it in surveyed.inliers_of.values())
    if surveyed.inlier_count < options.min_matches or vouchers < options.min_vouchers:
        return Refusal.UNSUPPORTED
    if share < policy.min_surveyed_share:
        return Refusal.LITTLE_SURVEYED
    return None if surveyed.agrees_with(answered) else Refusal.DISAGREES


def explained(size_px: tuple[int, int], inliers_px: Array, options: AdoptionOptions) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels of an image, (width, height), that are near a match (M, 2) that agrees."""
    width, height = size_px
    drawn = np.zeros((height, width), np.uint8)
    radius_px = max(1, round(options.explained_share * max(size_px)))
    for x, y in np.rint(inliers_px).astype(int).tolist():
        cv2.circle(drawn, (x, y), radius_px, (1,), cv2.FILLED)
    return np.asarray(drawn > 0)


def novelty(keypoints_px: Array, is_explained: NDArray[np.bool_]) -> float:
    """Share of keypoints (K, 2) that no match explains; 0 without keypoints."""
    if not len(keypoints_px):
        return 0.0
    height, width = is_explained.shape
    columns, rows = np.rint(keypoints_px).astype(int).clip(0, [width - 1, height - 1]).T
    return float((~is_explained[rows, columns]).mean())


def mask_of(ignored: NDArray[np.bool_]) -> bytes:
    """A mask file that ignores these pixels (H, W)."""
    _, png = cv2.imencode(".png", np.where(ignored, 0, 255).astype(np.uint8))
    return png.tobytes()


def should_show(
    centres: Array, axes: Array, pose: RigidTransform, distance_m: float, options: AdoptionOptions
) -> NDArray[np.intp]:
    """Indices of the references that see what a photograph at a pose sees, which is at this distance."""
    near = np.linalg.norm(centres - pose.translation, axis=1) <= options.same_viewpoint_share * distance_m
    looks = axes @ pose.rotation[:, 2] >= math.cos(math.radians(options.same_viewpoint_deg))
    return np.flatnonzero(near & looks)


def with_share(standing: Standing, share: float, now_us: int, holder: str, options: AdoptionOptions) -> Standing:
    """The knowledge of a place after another photograph, of which surveyed references support this share.

    Each holder counts once a day (UTC), and each day with so many.
    """
    day = str(now_us // DAY_US)
    today = [it for it in standing.surveyed_by if it.partition(":")[0] == day]
    if len(today) >= options.photographs_a_day or any(it.split(":")[1] == holder for it in today):
        return standing
    witnesses = (*standing.surveyed_by, f"{day}:{holder}:{100 * share:.0f}")[-options.remembered :]
    median = float(np.median([_share_of(it) for it in witnesses]))  # which less than half of the holders cannot hold up
    count = standing.photograph_count + 1
    return replace(standing, surveyed_share=median, photograph_count=count, surveyed_by=witnesses)


def _share_of(witness: str) -> float:
    return float(witness.rpartition(":")[2]) / 100


def needs_survey(standing: Standing, policy: AdoptionPolicy, options: AdoptionOptions) -> bool:
    """Whether photographs of a place show too little of what was surveyed, on so many days and from so many holders."""
    least, share = policy.min_surveyed_share, standing.surveyed_share
    little = [it.rpartition(":")[0] for it in standing.surveyed_by if _share_of(it) < least]
    is_little = share is not None and share < least and len(little) >= options.least_photographs
    return is_little and _are_enough(little, options)


def _are_enough(witnesses: Collection[str], options: AdoptionOptions) -> bool:
    """Whether witnesses, "DAY:HOLDER", are of enough days, and enough without the holder with most of them.

    Or one is of a holder who may change the scene.
    """
    days = {it.partition(":")[0] for it in witnesses}
    of_holder = Counter(it.partition(":")[2] for it in witnesses)
    are_others = len(witnesses) - max(of_holder.values(), default=0) >= options.contradicting_others
    return len(days) >= options.contradicting_days and ("" in of_holder or are_others)


def holder_of(principal: Principal) -> str:
    """Short name of a caller for `with_photograph`; empty for one who may change scenes."""
    if principal.role >= Role.WRITE:
        return ""
    return hashlib.sha256("/".join(principal.holder).encode()).hexdigest()[:16]


def adopter_of(holder: str, now_us: int) -> str:
    """Who adopts a photograph, and on which day (UTC): at each place once; empty for who may change the scene."""
    return holder and f"{now_us // DAY_US}:{holder}"


def with_photograph(standing: Standing, share: float, now_us: int, holder: str, options: AdoptionOptions) -> Standing:
    """What is known of a reference after a photograph that should show what it shows has this share of matches with it.

    Contradictions in a row are counted, one of each holder a day (UTC); a photograph that agrees ends the row.
    """
    if share >= 2 * options.contradicting_share:
        return replace(standing, contradiction_count=0, contradicted_by=())
    witness = f"{now_us // DAY_US}:{holder}"
    if share >= options.contradicting_share or witness in standing.contradicted_by:
        return standing
    return replace(
        standing,
        contradiction_count=standing.contradiction_count + 1,
        contradiction_time_us=now_us,
        contradicted_by=(*standing.contradicted_by, witness)[-MOST_WITNESSES:],
    )


def is_contradicted(standing: Standing, options: AdoptionOptions) -> bool:
    """Whether photographs contradict a reference so often, on so many days and from so many holders that it retires."""
    is_often = standing.contradiction_count >= options.contradictions
    return is_often and _are_enough(standing.contradicted_by, options)


def with_usefulness(usefulness: float, share: float, options: AdoptionOptions, *, is_own: bool = False) -> float:
    """Usefulness of an adopted reference after a photograph of its place that has this share of matches with it.

    One of the holder for whom it was adopted, `is_own`, makes it no more useful than others have, or than a new one is.
    """
    worth = min(share, max(usefulness, options.first_usefulness)) if is_own else share
    return usefulness + (worth - usefulness) / options.remembered


def is_adopted_for(adopted_by: str, holder: str) -> bool:
    """Whether a reference was adopted for a holder, see `adopter_of`; never for one who may change the scene."""
    return bool(holder) and adopted_by.partition(":")[2] == holder
