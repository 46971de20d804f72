"""Compile the lattice kernels ahead of their first use.

A process that compiles a kernel itself runs other machine code than processes that load it from numba's cache. That
code is slower and differs in the last bits. `keep_flow` therefore lets another process compile.
"""

import sys
from functools import cache

import numpy as np

from vstent.flow.lattice.kernels import d3q19, exchange, lanes
from vstent.kernels.first_use import ensure_cached


@cache
def keep_flow() -> None:
    """Make sure that numba's cache holds the kernels of a flow; another process compiles those that are missing."""
    ensure_cached(flow, (sys.executable, "-c", f"from {__name__} import flow; flow()"))


def flow() -> None:
    """Call every kernel of a flow on one cell at rest, with arguments of the types that a flow has."""
    stride = lanes.COUNT
    f, none = np.zeros(20 * stride, np.float32), np.zeros(0, np.int32)
    relaxation = np.float32(1.0), np.zeros(4, np.float32), np.full(1, np.inf, np.float32), np.float32(1.0)
    address = stride * np.arange(19, dtype=np.int32)[None, None]
    d3q19.update(
        f, (address, np.ones(1, np.int32), relaxation, d3q19.no_screen(1)), d3q19.NO_LINKS, *d3q19.undivided(1)
    )
    links, source = np.zeros((0, 6), np.int32), np.zeros(0, np.float32)
    nowhere = np.zeros(1, np.int32)
    of_openings = nowhere, links, none, none, np.zeros((1, 0, 2))
    d3q19.drive(f, stride, np.zeros((0, 9)), of_openings, np.zeros(3), source)
    d3q19.defer(f, links, np.zeros((0, 5), np.float32), source, source, np.float32(1.0))
    d3q19.balance(source, (nowhere, none, nowhere, none), source, np.float32(1.0))
    d3q19.moments(f, stride, none)
    times = d3q19.relaxation_times(f, stride, none, relaxation[0], relaxation[1])
    d3q19.resisted(np.zeros((0, 3), np.float32), np.zeros((0, d3q19.ENTRY), np.float32), times, np.float32(1.0))
    d3q19.rescale(f, stride, none, links, np.float32(1.0), np.float32(1.0))
    empty, one, column = np.zeros(0, np.float32), np.float32(1.0), np.zeros((0, 3), np.float32)
    lack, push, group = np.zeros(1), np.zeros((2, 1)), none
    stencil = none, nowhere, none, np.zeros((0, 2), np.float32), group, column
    exchange.carry(f, stride, stencil, push[0], (f, stride, none, empty), (one, one, relaxation[1], one, one))
    exchange.add_crossed(f, 0, np.zeros(2, np.int32), 1.0, lack)
    jump = exchange.jumps(f, stride, f, stride, (none, np.zeros((0, 8), np.int32), group), one, 1)
    exchange.answer(lack, jump, lack, push, (1.0, 1.0))
    exchange.take(f, none, group, np.zeros(0), lack)
