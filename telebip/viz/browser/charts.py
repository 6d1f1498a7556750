"""Time series beside the robots: the plots of `telebip.viz.series`, drawn by uPlot in the browser."""

from collections.abc import Mapping, Sequence

import numpy as np
import viser
from viser import uplot

from telebip.viz.scene import Color
from telebip.viz.series import Array, Plot

TITLES = {"motion": "speed", "cost": "energy", "gait": "feet", "reward": "rewards", "effort": "effort", "joints": "joints"}
"""Folders of charts by rows of `telebip.viz.series`, in the order in which they stand."""
OPEN = ("motion", "cost", "gait", "reward")
EVERY = 2  # policy steps from one point to the next


class Charts:
    """One chart for each plot, made when its curves are first seen, in folders."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Make the folders where the GUI is being built."""
        self._gui = gui
        self._folders = {row: gui.add_folder(title, expand_by_default=row in OPEN) for row, title in TITLES.items()}
        self._charts: dict[str, viser.GuiUplotHandle] = {}
        self._curves: dict[str, list[str]] = {}

    def show(self, plots: Mapping[str, Plot], time: Array) -> None:
        """Draw plots over `time` [s]; charts whose curves are others now are made anew."""
        for name in self._charts.keys() - plots.keys():
            self._charts.pop(name).remove()
        for name, plot in plots.items():
            curves = plot.curves.items()
            data = tuple(np.asarray(v, np.float32)[::-EVERY][::-1] for v in (time, *(curve.values for _, curve in curves)))
            if name in self._charts and self._curves[name] == list(plot.curves):
                self._charts[name].data = data  # pyright: ignore[reportAttributeAccessIssue]
                continue
            if name in self._charts:
                self._charts.pop(name).remove()
            lines = [line(curve_name, curve.color, curve.width) for curve_name, curve in curves]
            self._curves[name] = list(plot.curves)
            with self._folders[plot.row]:
                self._charts[name] = chart(self._gui, plot.title, data, "time [s]", lines)


def line(name: str, color: Color, width: float = 1.5) -> uplot.Series:
    """Return how a curve is drawn."""
    return uplot.Series(label=name, stroke=f"rgb{color}", width=width)


def chart(
    gui: viser.GuiApi, title: str, data: tuple[np.ndarray, ...], over: str, lines: Sequence[uplot.Series]
) -> viser.GuiUplotHandle:
    """Add a chart: `data` begins with what it is drawn `over`, and has one array for each of `lines`."""
    series, scales = (uplot.Series(label=over), *lines), {"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)}
    return gui.add_uplot(data, series, title=title, scales=scales, legend=uplot.Legend(show=True), aspect=2.2)
