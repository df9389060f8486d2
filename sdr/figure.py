"""What every figure needs: a canvas that goes to a file alone, the times of the attacks, and the names of the channels."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

SIZE_IN = (9.0, 5.0)


def canvas(size: tuple[float, float] = SIZE_IN) -> Any:
    """An empty figure of ``size`` inches; matplotlib is imported here, and pyplot's state is not used."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(fig)
    return fig


@contextlib.contextmanager
def figure(
    path: Path,
    title: str,
    rows: int = 1,
    projection: str | None = None,
    size: tuple[float, float] = SIZE_IN,
    widths: tuple[float, ...] = (1.0,),
    sharex: bool = True,
) -> Iterator[Any]:
    """A figure of ``rows`` axes, sharing x (in columns of ``widths``) or not, saved to ``path`` on leaving."""
    fig = canvas(size)
    axes = fig.subplots(
        rows,
        len(widths),
        sharex="col" if rows > 1 and sharex else False,
        width_ratios=widths,
        subplot_kw={"projection": projection} if projection else None,
    )
    fig.suptitle(title)
    for ax in np.ravel(axes):
        ax.grid(alpha=0.3)
    yield axes
    fig.savefig(path, dpi=130)


def new_figure(rows: int, columns: int, size=(9.0, 6.0), **options):
    """(figure, axes) of ``rows`` by ``columns``."""
    fig = canvas(size)
    return fig, fig.subplots(rows, columns, **options)


def save_figure(fig: Any, out_dir: str | Path, name: str) -> Path:
    """Write a matplotlib figure as PNG and release it."""
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{name}.png"
    fig.savefig(path, dpi=110)
    fig.clear()
    return path


def attacks(h5: h5py.File) -> list[tuple[float, float]]:
    """Times (begin, end) in s during which any jammer is on."""
    if "truth/jammers" not in h5:
        return []
    rows = h5["truth/jammers"][:]
    t_s, k = np.unique(rows["t_s"], return_inverse=True)
    on = np.bincount(k, rows["on"]) > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
    return [
        (float(t_s[a]), float(t_s[min(b, len(t_s) - 1)]))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def channel_name(group: h5py.Group) -> str:
    """Satellite of a channel's group, e.g. G07."""
    system = {"L1CA": "G", "E1B": "E", "E1C": "E"}[group["epochs"].attrs["signal"]]
    return f"{system}{group['epochs'].attrs['prn']:02d}"
