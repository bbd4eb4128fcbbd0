"""The depths of a folder that are used. Imports what it needs when it runs, so that --help answers at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapless.depth import DepthSensor
    from mapless_tools.dataset import DepthFile


@dataclass(frozen=True)
class DepthOptions:
    """Use of the depths of a folder, and what its layout does not say of them; each field is a flag.

    `depth_sensor` and `depth_unit` replace the layout's own; the unit is the length of 1 in the values of a depth, in
    the folder's unit of length. `depth_topic` is of a recording.
    """

    no_depth: Annotated[bool, typer.Option("--no-depth", help="Leave out the depths of photographs.")] = False
    depth_sensor: Annotated[
        str,
        typer.Option(
            help="Sensor of the depths, where it is not the layout's: structured_light, stereo, time_of_flight, "
            "phone_lidar, rendered, unknown."
        ),
    ] = ""
    depth_unit: Annotated[
        float | None,
        typer.Option(help="Length of 1 in depths, where it is not the layout's, in the folder's unit: 0.001."),
    ] = None

    depth_topic: Annotated[
        str,
        typer.Option(help="Of a recording: topic of the depths, where there are several; default: the aligned ones."),
    ] = ""

    def __post_init__(self) -> None:
        if self.no_depth and (self.depth_sensor or self.depth_unit is not None):
            raise ValueError("--no-depth leaves out what --depth-sensor and --depth-unit describe: give one of them")
        self.sensor()
        if self.depth_unit is not None:
            from mapless.depth import MAX_UNIT_M, MIN_UNIT_M

            if not MIN_UNIT_M <= self.depth_unit <= MAX_UNIT_M:
                raise ValueError(f"--depth-unit must be {MIN_UNIT_M:g} to {MAX_UNIT_M:g}, is {self.depth_unit:g}")

    def sensor(self) -> DepthSensor | None:
        """The sensor, None for the layout's; ValueError for an unknown one."""
        from mapless.depth import DepthSensor

        kinds = [it.value for it in DepthSensor]
        if self.depth_sensor and self.depth_sensor not in kinds:
            raise ValueError(f"--depth-sensor must be one of {', '.join(kinds)}, not {self.depth_sensor!r}")
        return DepthSensor(self.depth_sensor) if self.depth_sensor else None

    def of(self, depth: DepthFile | None) -> DepthFile | None:
        """A depth as it is used, from what its layout says of it; None if it is not."""
        if depth is None or self.no_depth:
            return None
        if (sensor := self.sensor()) is not None:
            depth = replace(depth, sensor=sensor, noise=None)
        return depth if self.depth_unit is None else replace(depth, unit_m=self.depth_unit)
