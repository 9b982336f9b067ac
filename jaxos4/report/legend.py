"""The legend below a figure. The page hides an entry together with the estimator that it names."""

import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .scenario import bounds, names
from .style import BOUND_DASHES, INK, estimator_gid, styles

# Width of an entry [inch].
_WIDTH = 1.4


def legend(
    figure: Figure, data: xr.Dataset, *, with_bounds: bool = False, lines: bool = True, markers: bool = True
) -> None:
    """Adds an entry for each bound and each estimator, drawn with lines, with markers or with both."""
    handles, labels, gids = [], [], []
    if with_bounds:
        for dash, seen in zip(BOUND_DASHES, bounds(data), strict=False):
            handles.append(Line2D([], [], color=INK, linestyle=dash, linewidth=1.1))
            labels.append(f"bound, {seen}")
            gids.append(None)
    for place, (name, look) in enumerate(styles(names(data, "estimator")).items()):
        marker = look.marker if markers else None
        handles.append(Line2D([], [], color=look.color, marker=marker, linestyle=look.dash if lines else "none"))
        labels.append(name)
        gids.append(estimator_gid(place))
    rows = -(-len(labels) // int(figure.get_figwidth() / _WIDTH))
    columns = -(-len(labels) // rows)
    box = figure.legend(handles, labels, loc="outside lower center", ncols=columns, handlelength=3)
    for handle, text, gid in zip(box.legend_handles, box.get_texts(), gids, strict=True):
        if gid is not None and handle is not None:
            handle.set_gid(gid)
            text.set_gid(gid)
