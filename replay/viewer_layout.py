"""How a recording is laid out in rerun: entity paths, time series, and the blueprint that is saved with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle
from typing import Any

from prim.environment import environment
from replay.viewing.protocol import Scene

with environment(RUST_LOG="off"):  # rerun's log lines: what they say is checked and becomes an error
    import rerun as rr
    import rerun.blueprint as rrb

STAMP, SCAN = "stamp", "scan"
"""The two timelines: the log's own time, and the number of the scan."""

SCENE = "map"
"""What all mappers share lies under this path: scans, the laser, its trajectory, the true world."""

FIELD_OF_VIEW = math.radians(55)
"""The viewer's vertical field of view (rad)."""

Color = tuple[int, int, int]

SCORES = {
    "occupied_f1": ("occupied F1", (255, 255, 255)),
    "occupied_precision": ("occupied precision", (86, 180, 233)),
    "occupied_recall": ("occupied recall", (230, 159, 0)),
    "free_accuracy": ("free accuracy", (0, 158, 115)),
    "auc": ("AUC", (204, 121, 167)),
}
"""The map's scores over time: label and colour of each line."""

DETECTION_SCORES = {
    "f1": ("F1", (255, 255, 255)),
    "precision": ("precision", (86, 180, 233)),
    "recall": ("recall", (230, 159, 0)),
    "iou": ("mean IoU", (0, 158, 115)),
}
"""Scores of the detections over time."""

LENGTH_ERRORS = {
    "position": ("position, mm", (86, 180, 233)),
    "width": ("width, mm", (230, 159, 0)),
    "height": ("height, mm", (0, 158, 115)),
}
"""Mean errors of the detections over time; that of the angle has a plot of its own."""

ANGLE_ERROR = ("angle, degrees", (204, 121, 167))

POSITION_ERROR = (("position, mm", (86, 180, 233)), ("expected (1σ), mm", (40, 90, 130)))
HEADING_ERROR = (("heading, degrees", (230, 159, 0)), ("expected (1σ), degrees", (130, 90, 0)))
"""Errors of the poses over time, each with its expected standard deviation, where there is one."""

MAPPING_TIME = ("mapping, ms a scan", (86, 180, 233))

MAPPER_COLORS: tuple[Color, ...] = ((86, 180, 233), (230, 159, 0), (0, 158, 115))
"""The colours of mappers that are compared, in their order."""

OTHERS = "other scores (hidden)"
OTHERS_COLOR: Color = (120, 120, 120)
"""What a comparison does not show of an entity; a click on its name in the legend does."""


def layers(mappers: Sequence[str]) -> dict[str, str]:
    """Return where each mapper's entities lie.

    Args:
        mappers: The mappers of a replay.

    Returns:
        By mapper, the prefix of its entities' paths: empty for a single one, else its name, as in ``det/map``.
    """
    return {mapper: f"{mapper}/" if len(mappers) > 1 else "" for mapper in mappers}


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Lay out the views: maps at the left, tables and plots at the right.

    Args:
        scene: What the recording shows.

    Returns:
        The blueprint.
    """
    plots = _plots(scene) if len(scene.mappers) == 1 else _comparisons(scene)
    maps = [_map_view(scene, mapper, layer) for mapper, layer in layers(scene.mappers).items()]
    events = rrb.TextLogView(origin="events", name="Events")
    if len(maps) > 2:  # the result fills the square of four
        left, right = [*maps, _result_view(scene)], [*plots, events]
    else:
        left, right = maps, [_result_view(scene), *plots, events]
    shares = [*[2.0] * (len(right) - 1), 1.2]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Grid(*left, grid_columns=1 if len(left) < 3 else 2) if len(left) > 1 else left[0],
            rrb.Vertical(*right, row_shares=shares),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _map_view(scene: Scene, mapper: str, layer: str) -> Any:
    """Lay out a mapper's map from above; behind it the visits, where they are counted."""
    x0, y0, x1, y1 = scene.bounds
    centre_x, centre_y = (x0 + x1) / 2, (y0 + y1) / 2
    height = 1.1 * max(y1 - y0, x1 - x0) / 2 / math.tan(FIELD_OF_VIEW / 2)
    top_down = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(centre_x, centre_y - 1e-3 * height, height),
        look_target=(centre_x, centre_y, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )

    def from_above(origin: str, name: str, contents: Sequence[str]) -> rrb.Spatial3DView:
        return rrb.Spatial3DView(
            origin=origin,
            contents=contents,
            name=name,
            eye_controls=top_down,
            line_grid=rrb.LineGrid3D(visible=False),
            background=(235, 235, 235, 255),
        )

    own = f"{layer}map"
    view = from_above(own, f"Map ({mapper}), from above", [f"/{path}/**" for path in dict.fromkeys((own, SCENE))])
    if mapper not in scene.counting:
        return view
    visits = from_above(f"{layer}evidence", f"Visits ({mapper}): rays per cell", [f"/{layer}evidence/**"])
    return rrb.Tabs(view, visits, active_tab=0)


def _result_view(scene: Scene) -> Any:
    """Lay out the summary; beside it the tables of detections, and a single mapper's crops."""
    summary = rrb.TextDocumentView(origin="summary", name="Result")
    of_mapper = layers(scene.mappers)
    if not scene.detecting:
        return summary
    if len(of_mapper) == 1:
        table = rrb.TextDocumentView(origin="detections", name="Detections")
        return rrb.Tabs(
            summary, table, rrb.Spatial2DView(origin="crops", name="Crops, as the networks see them"), active_tab=0
        )
    tables = [
        rrb.TextDocumentView(origin=f"{of_mapper[mapper]}detections", name=f"Detections ({mapper})")
        for mapper in scene.detecting
    ]
    return rrb.Tabs(summary, *tables, active_tab=0)


def _plots(scene: Scene) -> list[Any]:
    """Lay out the time series: errors of detections, accuracy of the map, errors of poses, timings."""
    plots: list[Any] = []
    unit = rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True)
    if scene.has_errors:
        found = _plot("errors/found", "Primitives found", axis_y=unit)
        lengths, angle = _plot("errors/lengths", "Errors: lengths"), _plot("errors/angle", "Errors: angle")
        plots.append(rrb.Tabs(found, lengths, angle, active_tab=0))
    if scene.has_scores:
        plots.append(_plot("scores", "Map accuracy", axis_y=unit))
    return [*plots, *_pose_plots(scene), _plot("timing", "Mapping time")]


def _comparisons(scene: Scene) -> list[Any]:
    """Lay out the time series of several mappers: of each quantity one line for each mapper."""
    plots: list[Any] = []
    unit = rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True)
    if scene.has_errors:
        found = _comparison(scene, "errors/found", len(DETECTION_SCORES), "Primitives found: F1", axis_y=unit)
        lengths = _comparison(scene, "errors/lengths", len(LENGTH_ERRORS), "Errors: position, mm")
        plots.append(rrb.Tabs(found, lengths, active_tab=0))
    if scene.has_scores:
        plots.append(_comparison(scene, "scores", len(SCORES), "Map accuracy: occupied F1", axis_y=unit))
    return [*plots, *_pose_plots(scene), _comparison(scene, "timing", 1, "Mapping time, ms a scan")]


def _pose_plots(scene: Scene) -> list[Any]:
    if not scene.has_pose_errors:
        return []
    position, heading = _plot("pose_error/position", "Pose error"), _plot("pose_error/heading", "Heading error")
    return [rrb.Tabs(position, heading, active_tab=0)]


def _comparison(scene: Scene, entity: str, series: int, name: str, **properties: Any) -> rrb.TimeSeriesView:
    """Plot the first of the ``series`` of an entity of each mapper, in the mapper's colour and with its name."""
    paths = {mapper: f"/{layer}{entity}" for mapper, layer in layers(scene.mappers).items()}
    styles = {
        path: rr.SeriesLines(
            names=[mapper, *[OTHERS] * (series - 1)],
            colors=[color, *[OTHERS_COLOR] * (series - 1)],
            visible_series=[True, *[False] * (series - 1)],
        )
        for (mapper, path), color in zip(paths.items(), cycle(MAPPER_COLORS), strict=False)
    }
    return _plot("/", name, contents=list(paths.values()), overrides=styles, **properties)


def _plot(origin: str, name: str, **properties: Any) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend, **properties)
