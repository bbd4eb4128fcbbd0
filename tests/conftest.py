"""What holds for all tests."""

from __future__ import annotations

import pytest
from hypothesis import settings

# Machines are shared: how long an example takes says nothing of the code.
settings.register_profile("shared", deadline=None)
settings.load_profile("shared")


def pytest_addoption(parser: pytest.Parser) -> None:
    """CI takes another tenth of the nightly tests each day."""
    parser.addoption("--tenth", type=int, choices=range(10), help="run only this tenth of the nightly tests")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselects the nightly tests of other tenths. Tests that share a file's costly set-up stay together."""
    tenth = config.getoption("--tenth")
    if tenth is None:
        return
    units = sorted({_unit(item) for item in items if item.get_closest_marker("nightly")})
    others = {unit for number, unit in enumerate(units) if number % 10 != tenth}
    config.hook.pytest_deselected(items=[item for item in items if _unit(item) in others])
    items[:] = [item for item in items if _unit(item) not in others]


def _unit(item: pytest.Item) -> str:
    module = item.getparent(pytest.Module)
    shares_set_up = module is not None and any(mark.name == "nightly" for mark in module.own_markers)
    return item.nodeid.partition("::")[0] if shares_set_up else item.nodeid
