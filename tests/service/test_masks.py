"""Masks through a server: stored and returned with a reference, refused by the field, the same again is no change."""

import hashlib
import io

import numpy as np
import pytest
from PIL import Image
from support.images import encode
from support.servers import CAMERA, PHOTO, Stubs, failure_of, localize_request, pose

from mapless import Client, InvalidArgument, NewReference

VALUES = np.full((CAMERA.height_px, CAMERA.width_px), 255, np.uint8)
VALUES[:20] = 0
NONE_LEFT = np.zeros_like(VALUES)


def png(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    return stream.getvalue()


MASK = png(VALUES)


def new(mask: bytes | None = MASK, name: str = "masked") -> NewReference:
    return NewReference(name, PHOTO, CAMERA, pose(5.0), mask)


def test_a_mask_is_kept_with_its_reference(client: Client, scene: str) -> None:
    stored = client.add_reference(scene, new())
    digest = hashlib.sha256(MASK).hexdigest()
    assert (stored.mask, stored.mask_sha256) == (None, digest)
    assert client.get_reference(scene, "masked", include_image=True).mask == MASK
    assert client.get_reference(scene, "masked").mask is None
    assert {it.reference_id: it.mask_sha256 for it in client.list_references(scene)}["masked"] == digest
    plain = client.get_reference(scene, "r0", include_image=True)
    assert (plain.mask, plain.mask_sha256) == (None, "")


def test_a_mask_of_everything_is_no_mask_of_a_reference(client: Client, scene: str) -> None:
    with pytest.raises(InvalidArgument, match="ignores the whole image") as raised:
        client.add_references(scene, [new(name="good"), new(png(NONE_LEFT))])
    assert (raised.value.reason, raised.value.field) == ("MASK_IGNORES_ALL", "requests[1].reference.mask")
    assert "good" not in {it.reference_id for it in client.list_references(scene)}


def test_a_reference_nearly_all_ignored_is_warned_of(client: Client, scene: str) -> None:
    inverted = png(np.where(np.arange(CAMERA.height_px)[:, None] < 60, NONE_LEFT, 255).astype(np.uint8))
    warnings = client.add_reference(scene, new(inverted)).warnings
    assert any("'masked' ignores 94 % of its image: 0 means ignore" in it for it in warnings)


@pytest.mark.parametrize(
    ("mask", "reason"),
    [
        (b"", "MASK_EMPTY"),
        (encode(".jpg", np.repeat(VALUES[..., None], 3, axis=2)), "MASK_NOT_PNG"),
        (png(VALUES[:-1]), "MASK_SIZE"),
        (MASK[:-20], "IMAGE_UNDECODABLE"),
    ],
    ids=["empty", "jpeg", "size", "cut"],
)
def test_a_wrong_mask_is_refused_by_its_field(stubs: Stubs, scene: str, mask: bytes, reason: str) -> None:
    request = localize_request(scene)
    request.mask = mask
    error = failure_of(stubs.localization.Localize, request)
    assert (error.code, error.reason, error.field) == ("INVALID_ARGUMENT", reason, "mask")
