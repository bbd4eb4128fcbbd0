"""Store text: names of scenes and references, tenants, keys, and the tokens of pages.

Laws: what is accepted as an id is ASCII and fits into names, keys and file names, whence it comes back as it was; keys
of two tenants are never the same and sort apart; a token leads on in the list that gave it, where that page ended, and
is refused by any other list; what no list gave is refused, or leads on from a legal id of one list.
"""

from __future__ import annotations

from random import Random

from mapless import names, wire
from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.security import DEFAULT_TENANT, end_of_keys, key_of, scene_id_of, tenant_of
from mapless_server.services.messages.queries import reference_ids_from_names
from mapless_server.services.messages.references import MAX_PAGE_SIZE, Page
from mapless_tools.dataset import legal_id

from . import folders
from .target import MutateBytes, Target

_LISTS = (
    ("acme", "scenes"),
    ("acme", "scenes/hall"),
    ("acme", "scenes/hall audit"),
    ("acm", "e\nscenes"),
    ("b", "scenes"),
)
_MOST = 4


def check(data: bytes) -> bool:
    """See Target."""
    kind, contents = folders.split(data)
    texts = [content.decode(errors="surrogateescape" if kind & 8 else "replace") for content in contents]
    text = texts[0]
    if kind % 4 == 0:
        return _check_names(text)
    if kind % 4 == 1:
        return _check_page(text, kind)
    if kind % 4 == 2:
        return _check_lists(texts)
    assert names.check_id(legal_id(text, ()))
    assert legal_id(text, {legal_id(text, ())}) != legal_id(text, ())
    return True


def _check_names(text: str) -> bool:
    accepted = False
    for is_name, parse in (
        (False, lambda: (wire.checked_id(text, "name"),)),
        (True, lambda: (wire.scene_id_from_name(text, "name"),)),
        (True, lambda: wire.reference_ids_from_name(text, "name")),
    ):
        try:
            ids = parse()
        except FieldError as error:
            assert error.field == "name"
            assert str(error).isascii()
            assert str(error).isprintable()
            assert len(str(error)) < 1000
            continue
        accepted = True
        for it in ids:
            assert it.isascii()
            assert it.isprintable()
            assert 1 <= len(it) <= 128
            assert not set(it) & set("/\\: \t\n'\"")
            assert names.check_id(it) == it == legal_id(it, ())
        if is_name:
            assert text == (names.scene_name(*ids) if len(ids) == 1 else names.reference_name(*ids))
        _check_keys(ids[0])
    return accepted


def _check_keys(scene_id: str) -> None:
    keys = {key_of(tenant, scene_id) for tenant in (DEFAULT_TENANT, "a", "a0", scene_id)}
    assert len(keys) == len({DEFAULT_TENANT, "a", "a0", scene_id})
    for tenant in ("a", "a0", scene_id):
        key = key_of(tenant, "hall" if tenant == scene_id else scene_id)
        assert tenant_of(key) == tenant
        assert names.check_id(scene_id_of(key))
        if tenant != DEFAULT_TENANT:
            assert f"{tenant}/" < key < end_of_keys(tenant)


def _check_page(token: str, kind: int) -> bool:
    if any(0xD800 <= ord(c) < 0xE000 for c in token):
        return False  # no message holds half a character
    accepted = []
    for tenant, collection in _LISTS:
        size = kind * 5 - 20
        try:
            page = Page(pb.ListScenesRequest(page_size=size, page_token=token), tenant, collection)
        except FieldError as error:
            assert error.field in ("page_token", "page_size")
            continue
        assert 2 <= page.limit <= MAX_PAGE_SIZE + 1
        if not token:
            assert page.after == ""
            continue
        accepted.append(page.after)
        ids = [page.after] * page.limit
        records, following = page.cut(ids, str)
        assert len(records) == page.limit - 1
        next_page = Page(pb.ListScenesRequest(page_token=following), tenant, collection)
        assert next_page.after == names.check_id(page.after)
    assert len(accepted) <= 1, "one token leads on in two lists"
    return bool(accepted)


def _check_lists(texts: list[str]) -> bool:
    try:
        ids = reference_ids_from_names(texts, "hall", _MOST)
    except FieldError as error:
        assert error.field == "references" or error.field in {f"references[{i}]" for i in range(len(texts))}
        return False
    assert [names.reference_name("hall", it) for it in ids] == texts
    assert len(set(texts)) == len(texts) <= _MOST
    return True


def _token(tenant: str, collection: str) -> bytes:
    page = Page(pb.ListScenesRequest(page_size=1), tenant, collection)
    return page.cut(["hall", "office"], str)[1].encode()


def seeds() -> list[bytes]:
    """Names and tokens that are right."""
    texts = [(0, b"scenes/hall"), (0, b"scenes/hall/references/frame-0001.left"), (0, b"hall_1"), (0, b"default")]
    tokens = [(5, _token(*it)) for it in _LISTS]
    lists = [(2, folders.SEPARATOR.join([b"scenes/hall/references/a", b"scenes/hall/references/b"]))]
    made = [(3, "Küche/Bild 1..jpg".encode()), (3, b"seq-01/frame-000000.color")]
    return [bytes([kind]) + text for kind, text in (*texts, *tokens, *lists, *made)]


def mutate(data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
    """See Target."""
    kind, contents = folders.split(data)
    if random.random() < 0.1:
        kind = random.randrange(256)
    chosen = random.randrange(len(contents))
    contents[chosen] = mutate_bytes(contents[chosen])
    return folders.joined(kind, contents)


TARGET = Target(
    seeds,
    check,
    mutate,
    max_bytes=1024,
    words=(b"scenes/", b"/references/", b"..", b"default", b"acme\nscenes\n", b"YWNtZQpzY2VuZXMK", folders.SEPARATOR),
)
