"""Options and settings of all tests."""

import zlib

import pytest
from hypothesis import settings
from support.users import leave_the_users_environment

# Machines are shared: how long an example takes says nothing of the code.
settings.register_profile("shared", deadline=None)
settings.load_profile("shared")
leave_the_users_environment()


def pytest_addoption(parser: pytest.Parser) -> None:
    """CI takes another tenth of the nightly tests each day."""
    parser.addoption("--tenth", type=int, choices=range(10), help="run only this tenth of the nightly tests")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselects the nightly tests of other tenths."""
    tenth = config.getoption("--tenth")
    if tenth is None:
        return
    # By name, so that a new test moves no other to another day.
    others = {unit for unit in map(_unit, items) if unit and zlib.crc32(unit.encode()) % 10 != tenth}
    config.hook.pytest_deselected(items=[item for item in items if _unit(item) in others])
    items[:] = [item for item in items if _unit(item) not in others]


def _unit(item: pytest.Item) -> str:
    """The tests that a nightly test runs with: those whose marker has one name and one costly set-up; else itself.

    Those of `every_tenth` run with each.
    """
    marker = item.get_closest_marker("nightly")
    if marker is None or marker.kwargs.get("every_tenth"):
        return ""
    return str(marker.args[0]) if marker.args else item.nodeid
