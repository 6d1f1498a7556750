"""The prepared layouts of recordings in the rerun viewer: the robots on the left, time series on the right."""

from collections.abc import Mapping, Sequence

import rerun as rr
import rerun.blueprint as rrb

from telebip.viz.series import SHARED, Plot, Row

AROUND_THE_CURSOR = rrb.VisibleTimeRange(
    "time",
    start=rrb.TimeRangeBoundary.cursor_relative(seconds=-2.0),
    end=rrb.TimeRangeBoundary.cursor_relative(seconds=2.0),
)
"""Strides can be told apart in four seconds; over a whole walk they run together."""


def walk_layout(robots: Sequence[str], plots: Mapping[str, Plot]) -> rrb.Blueprint:
    """Lay out a recording of walks.

    Args:
        robots: entities' names below `world` and `plot`, from left to right; the camera follows the middle one.
        plots: what there is to see of each, by the name below `plot/<robot>`.
    """

    def view(name: str, shown: Sequence[str]) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=plots[name].title,
            origin="/plot",
            contents=[f"+ /plot/{robot}/{name}/**" for robot in shown]
            + [f"- /plot/{robot}/{name}/command" for robot in shown[1:]],  # it would be drawn over the first one's
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
            time_ranges=None if plots[name].row in SHARED else AROUND_THE_CURSOR,
            axis_y=rrb.ScalarAxis(range=(0.0, 1.5)) if plots[name].row == "cost" else None,  # a start costs far more
        )

    def row(kind: Row, *shown: str) -> rrb.TimeSeriesView | rrb.Tabs:
        views = [view(name, shown) for name, plot in plots.items() if plot.row == kind]
        return views[0] if len(views) == 1 else rrb.Tabs(*views)

    def details(robot: str, name: str | None = None) -> rrb.Vertical:
        rows = [row(kind, robot) for kind in ("gait", "joints", "effort", "reward")]
        return rrb.Vertical(*rows, name=name, row_shares=[3, 2, 2, 2])

    below = details(robots[0]) if len(robots) == 1 else rrb.Tabs(*(details(robot, robot.replace("_", " ")) for robot in robots))
    series = rrb.Vertical(row("motion", *robots), row("cost", *robots), below, row_shares=[2, 2, 9])
    return rrb.Blueprint(
        rrb.Horizontal(robots_view(f"/world/{robots[len(robots) // 2]}/trunk", len(robots)), series, column_shares=[3, 2]),
        rrb.TimePanel(timeline="time", play_state="playing", loop_mode="all", state="collapsed"),
        collapse_panels=True,
    )


def training_layout(curves: Mapping[str, Sequence[str]]) -> rrb.Blueprint:
    """Lay out the live view of a training: `curves` are the entities of each plot, by its title."""
    everything = (rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())
    charts = [
        rrb.TimeSeriesView(
            name=title,
            origin="/",
            contents=list(entities),
            plot_legend=rrb.PlotLegend(visible=len(entities) > 1 or "**" in entities[0]),
            axis_x=rrb.TimeAxis(view_range=rr.TimeRange(*everything)),
            time_ranges=rrb.VisibleTimeRange("samples", start=everything[0], end=everything[1]),
        )
        for title, entities in curves.items()
    ]
    return rrb.Blueprint(
        rrb.Horizontal(robots_view(None, 4), rrb.Grid(*charts, grid_columns=2), column_shares=[1, 1]),
        rrb.TimePanel(timeline="samples", play_state="following", state="collapsed"),
        collapse_panels=True,
    )


def robots_view(followed: str | None, robots: int) -> rrb.Spatial3DView:
    """Show `robots` below `world` on a floor grid of half metres, from the right and the front; follow an entity, if any."""
    away = 1.0 + 0.35 * (robots - 1)
    ahead = 0.0 if followed else 1.2  # m: where robots that the camera does not follow are halfway
    return rrb.Spatial3DView(
        name="robots" if robots > 1 else "robot",
        origin="/world",
        background=[205, 215, 226],
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, color=[120, 130, 140]),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=[ahead + 1.2 * away, -2.0 * away, 0.8 * away],
            look_target=[ahead, 0.0, 0.45],
            tracking_entity=followed,
        ),
    )
