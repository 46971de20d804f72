"""Collision of the 19 populations of one cell, or of as many cells as a vector register holds.

Every number may be a float32 or `vstent.flow.lattice.kernels.lanes`. Populations are numbered as in
`vstent.flow.lattice.kernels.d3q19`; their rest weights are subtracted.

The collision is regularised: of the even (symmetric) part only the stress is kept (Latt and Chopard 2006, Math. Comput.
Simul. 72:165, eq. 12), without its trace, which only carries sound. The odd (antisymmetric) part has its own relaxation
rate (Ginzburg, Verhaeghe and d'Humieres 2008, Commun. Comput. Phys. 3, 427), which is raised in fast flow
(`_relaxation`). The equilibrium is that of incompressible flow (He and Luo 1997, J. Stat. Phys. 88, 927, eq. 20): the
steady state is free of divergence at any lattice speed.

D3Q19 lacks two kinds of moments. Without them a round jet bends towards the diagonals of the grid. They are replaced as
follows:

- Fourth moments follow from the second ones, <xxyy> = density / 9 + (ux ux + uy uy) / 3 (Bauer and Ruede 2018,
  arXiv:1803.04937, sec. 3). The usual equilibrium of D3Q19 lacks the term uz uz / 6 there.
- The moment <xxyz> cannot be represented. Its effect on the advection of the stress, d/dz of a sixth of (uz n_xz +
  ...), is added to the third moments (`_third`).
"""

from typing import Any

import numpy as np
from numba import njit

from vstent.flow.lattice.kernels.lanes import any_positive, larger, root

_THIRD, _DIAGONAL = np.float32(1 / 3), np.float32(1 / 36)
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX, _EIGHT = (
    np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
)
_THREE_HALVES, _QUARTER, _EIGHTH, _TWELFTH, _SIXTEENTH, _TWENTY_FOURTH, _FORTY_EIGHTH, _TINY = (
    np.float32(x) for x in (3 / 2, 1 / 4, 1 / 8, 1 / 12, 1 / 16, 1 / 24, 1 / 48, 1e-12)
)


@njit(cache=True, forceinline=True, error_model="numpy")
def moments_of(f: Any) -> tuple[Any, Any, Any]:
    """Return density deviation, momentum (3) and momentum flux xx, yy, zz, xy, xz, yz of the populations."""
    s1, s2, s3 = f[1] + f[2], f[3] + f[4], f[5] + f[6]
    s4, s5, s6 = f[7] + f[8], f[9] + f[10], f[11] + f[12]
    s7, s8, s9 = f[13] + f[14], f[15] + f[16], f[17] + f[18]
    d1, d2, d3 = f[1] - f[2], f[3] - f[4], f[5] - f[6]
    d4, d5, d6 = f[7] - f[8], f[9] - f[10], f[11] - f[12]
    d7, d8, d9 = f[13] - f[14], f[15] - f[16], f[17] - f[18]
    s45, s67, s89 = s4 + s5, s6 + s7, s8 + s9
    diagonal = s1 + (s45 + s67), s2 + (s45 + s89), s3 + (s67 + s89)
    density = diagonal[0] + ((f[0] + s89) + (s2 + s3))
    momentum = d1 + ((d4 + d5) + (d6 + d7)), d2 + ((d4 - d5) + (d8 + d9)), d3 + ((d6 - d7) + (d8 - d9))
    return density, momentum, (*diagonal, s4 - s5, s6 - s7, s8 - s9)


@njit(cache=True, forceinline=True, error_model="numpy")
def departure(flux: Any, u: Any) -> tuple[Any, ...]:
    """Return the stress (6): momentum flux minus u u, without its trace, which only carries sound."""
    xx, yy, zz = flux[0] - u[0] * u[0], flux[1] - u[1] * u[1], flux[2] - u[2] * u[2]
    trace = (xx + yy + zz) * _THIRD
    return xx - trace, yy - trace, zz - trace, flux[3] - u[0] * u[1], flux[4] - u[0] * u[2], flux[5] - u[1] * u[2]


@njit(cache=True, forceinline=True, error_model="numpy")
def _times(part: Any, n: Any) -> tuple[Any, ...]:
    """Return six moments times a number."""
    return part * n[0], part * n[1], part * n[2], part * n[3], part * n[4], part * n[5]


@njit(cache=True, forceinline=True, error_model="numpy")
def _plus_square(n: Any, u: Any) -> tuple[Any, ...]:
    """Return six second moments plus u u."""
    x, y, z = u
    return n[0] + x * x, n[1] + y * y, n[2] + z * z, n[3] + x * y, n[4] + x * z, n[5] + y * z


@njit(cache=True, forceinline=True, error_model="numpy")
def _third(u: Any, n: Any, part: Any) -> tuple[Any, ...]:
    """Return third moments xyy, xzz, xxy, yzz, xxz, yyz, times `part` / 4, that replace the missing moment <xxyz>.

    Each is added to the odd half of four diagonal pairs of populations, hence the quarter.
    """
    part = _TWENTY_FOURTH * part
    x, y, z = part * u[0], part * u[1], part * u[2]
    xx, yy, zz, xy, xz, yz = n
    by_x, by_y, by_z = x + x, y + y, z + z
    return (
        x * zz + by_z * xz,
        x * yy + by_y * xy,
        y * zz + by_z * yz,
        y * xx + by_x * xy,
        z * yy + by_y * yz,
        z * xx + by_x * xz,
    )


@njit(cache=True, forceinline=True, error_model="numpy")
def _even(density: Any, u: Any, flux: Any, trace: Any) -> tuple[Any, ...]:
    """Return the even parts (10) after collision: the rest population and half the sum of each of the nine pairs."""
    xx, yy, zz, xy, xz, yz = _times(_EIGHTH, flux)
    wx, wy, wz = u[0] * u[0], u[1] * u[1], u[2] * u[2]
    squared = wx + wy + wz
    # The pair along an axis is twice (a - b), the four pairs across it a + b: most operations serve both.
    share = _DIAGONAL * density + _FORTY_EIGHTH * (trace - squared)
    ax, ay, az = share + _TWENTY_FOURTH * wx, share + _TWENTY_FOURTH * wy, share + _TWENTY_FOURTH * wz
    common = _SIXTEENTH * trace + _FORTY_EIGHTH * squared
    bx, by, bz = common - xx, common - yy, common - zz
    pyz, pxz, pxy = ax + bx, ay + by, az + bz
    return (
        _THIRD * (density - _THREE_HALVES * trace + _HALF * squared),
        _TWO * (ax - bx),
        _TWO * (ay - by),
        _TWO * (az - bz),
        pxy + _TWO * xy,
        pxy - _TWO * xy,
        pxz + _TWO * xz,
        pxz - _TWO * xz,
        pyz + _TWO * yz,
        pyz - _TWO * yz,
    )


@njit(cache=True, forceinline=True, error_model="numpy")
def _odd(momentum: Any, third: Any) -> tuple[Any, ...]:
    """Return what is added to half the difference of each of the nine pairs (see `relaxed_pair`)."""
    x, y, z = _TWELFTH * momentum[0], _TWELFTH * momentum[1], _TWELFTH * momentum[2]
    xyy, xzz, xxy, yzz, xxz, yyz = third
    xy, xz, yx, yz, zx, zy = x + xyy, x + xzz, y + xxy, y + yzz, z + xxz, z + yyz
    return (
        _HALF * momentum[0] - _TWO * (xy + xz),
        _HALF * momentum[1] - _TWO * (yx + yz),
        _HALF * momentum[2] - _TWO * (zx + zy),
        xy + yx,
        xy - yx,
        xz + zx,
        xz - zx,
        yz + zy,
        yz - zy,
    )


@njit(cache=True, forceinline=True, error_model="numpy")
def relaxed_pair(a: Any, b: Any, even: Any, odd: Any, half_kept: Any) -> tuple[Any, Any]:
    """Return the collided populations of a pair, already swapped: the first belongs in the place of `a`."""
    new = odd + half_kept * (a - b)
    return even - new, even + new


@njit(cache=True, forceinline=True, error_model="numpy")
def relaxed(f: Any, even: Any, odd: Any, half_kept: Any) -> tuple[Any, ...]:
    """Return the 19 collided populations, each in the place of its opposite (see `relaxed_pair`)."""
    one = relaxed_pair(f[1], f[2], even[1], odd[0], half_kept)
    two = relaxed_pair(f[3], f[4], even[2], odd[1], half_kept)
    three = relaxed_pair(f[5], f[6], even[3], odd[2], half_kept)
    four = relaxed_pair(f[7], f[8], even[4], odd[3], half_kept)
    five = relaxed_pair(f[9], f[10], even[5], odd[4], half_kept)
    six = relaxed_pair(f[11], f[12], even[6], odd[5], half_kept)
    seven = relaxed_pair(f[13], f[14], even[7], odd[6], half_kept)
    eight = relaxed_pair(f[15], f[16], even[8], odd[7], half_kept)
    nine = relaxed_pair(f[17], f[18], even[9], odd[8], half_kept)
    return even[0], *one, *two, *three, *four, *five, *six, *seven, *eight, *nine


@njit(cache=True, forceinline=True, error_model="numpy")
def _relaxation(squared: Any, time: Any, limit: Any, odd_rate: Any) -> tuple[Any, Any]:
    """Return the relaxation time of the stress and the relaxation rate of the odd part.

    They are `time` and `odd_rate`, or higher ones where fast flow needs them for stability. Few cells do. The square
    root and the division are skipped where no cell does, because all later operations would wait for them.

    Waves on a uniform flow grow when the squared speed times (1 / rate - 1/2) exceeds about twice the viscosity: an
    eigenvalue of collision and streaming then exceeds 1 (von Neumann analysis with rates from 0.7 to 1.7, first along
    the grid axes). Three quarters of this limit are allowed; nothing then grows up to a speed of 0.2.
    """
    steep, slow, even = _THREE / limit, _ONE / odd_rate, time - _HALF
    rate = odd_rate + _ZERO * time  # of the type of `time`, for both branches
    if any_positive(larger(steep * steep * squared - even * even, (slow - _HALF) * squared - _HALF * even)):
        time = larger(time, _HALF + steep * root(squared))
        excess = larger((slow - _HALF) * squared - _HALF * (time - _HALF), _ZERO)
        rate = odd_rate + odd_rate * excess / (slow * squared - excess + _TINY)
    return time, rate


@njit(cache=True, forceinline=True, error_model="numpy")
def _kept_and_rate(u: Any, time: Any, limit: Any, odd_rate: Any) -> tuple[Any, Any]:
    """Return the fraction of the stress that is kept, and the relaxation rate of the odd part."""
    squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    time, rate = _relaxation(squared, time, limit, odd_rate)
    return _ONE - _ONE / time, rate


@njit(cache=True, forceinline=True, error_model="numpy")
def stress_size(f: Any) -> Any:
    """Return the norm of the stress in the populations, times the square root of 2."""
    _, u, flux = moments_of(f)
    xx, yy, zz, xy, xz, yz = departure(flux, u)
    return root(_TWO * (xx * xx + yy * yy + zz * zz + _TWO * (xy * xy + xz * xz + yz * yz)))


@njit(cache=True, forceinline=True, fastmath=True, error_model="numpy")
def thinned(size: Any, time: Any, law: Any) -> Any:
    """Return the relaxation time of shear-thinning blood from its `stress_size`.

    The strain rate is 1.5 / time times the departure of the second moments from equilibrium. It depends on the
    relaxation time itself, which is found by three fixed-point iterations from the viscosity at rest. Numbers must be
    scalars, not Lanes.

    References
    ----------
    Boyd, Buick and Green 2006, J. Phys. A 39, 14241, eq. 9.
    """
    found = time + law[0]
    for _ in range(3):
        rate = _THREE_HALVES * size / found
        found = time + law[0] * (_ONE + (law[1] * rate) ** law[2]) ** law[3]
    return found


@njit(cache=True, forceinline=True, error_model="numpy")
def rates(time: Any, odd_rate: Any) -> tuple[Any, Any]:
    """Return the viscosity, and 1/4 minus the product of (relaxation time - 1/2) of the stress and of the odd part.

    The second value is at least 0.
    """
    even = time - _HALF
    return even * _THIRD, larger(_QUARTER - (_ONE / odd_rate - _HALF) * even, _ZERO)


@njit(cache=True, forceinline=True, error_model="numpy")
def squared_reach(normal: Any) -> Any:
    """Return the squared distance along a unit normal over which links carry momentum across it: 1/2 to 1.

    It is the sum of w c_n^4 c_t^2 divided by that of w c_n^2 c_t^2, averaged over both tangents t, over the velocities
    c of D3Q19. It is 0 for the normal 0 of a region that resists alike in all directions.
    """
    x, y, z = normal[0] * normal[0], normal[1] * normal[1], normal[2] * normal[2]
    return _THREE * (x + y + z) - _EIGHT * (x * x + y * y + z * z) + _SIX * (x * x * x + y * y * y + z * z * z)


@njit(cache=True, forceinline=True, error_model="numpy")
def of_thin_sheet(across: Any, spread: Any, through: Any, blood: Any) -> tuple[Any, Any]:
    """Return the fractions of the tangential speed that remain in a cell of a screen and in the screen itself.

    The first applies to the half-force velocity of the cell, the second to the velocity in an ideal thin sheet. Two
    errors of a thin sheet on a grid are corrected:

    - The sheet is spread over layers of cells and slows the blood several times. Parts a and b of it in two layers a
      distance d apart act like the resistance R + a b d R R / stir instead of R. Here stir = viscosity + |u_n| / 2 is
      the rate at which momentum is exchanged between layers.
    - A force F on a cell changes its velocity by an additional (1/4 - L) F / stir along a grid axis, and by
      `squared_reach` times that in other directions. L is the product of (relaxation time - 1/2) of the stress and of
      the odd part. The term stems from the second difference of the force. With L far below 1/4 the drag of a dense
      braid would be twice its true value.

    `across` is the tangential resistance of the cell per time step; `spread` the sum of a b d R over all pairs of
    layers, R being the resistance of the whole sheet; `through` the velocity normal to the sheet; `blood` the viscosity
    and 1/4 - L times `squared_reach`.

    References
    ----------
    Ginzburg, Silva and Talon 2015, Phys. Rev. E 91, 023307: the second difference of the force.
    """
    viscosity, shortfall = blood
    stir = viscosity + _HALF * larger(through, _ZERO - through)
    # The ratio of the sheet's speed to the cell's is 2 stir / open. One division serves both, because it is expensive.
    open = stir + root(stir * (stir + _FOUR * spread)) + _TWO * shortfall * across
    free = _ONE / (open + stir * across)
    return open * free, _TWO * stir * free


@njit(cache=True, forceinline=True, error_model="numpy")
def resist(normal: Any, entry: Any, u: Any, blood: Any) -> tuple[Any, Any]:
    """Return the half-force velocity v = u + F / 2 in a screen, and its force F, from the velocity u without it.

    The force is F = -(along + quadratic |w|) v_n n - (across + quadratic |w| / 2) w_t. Here w is the velocity in a thin
    sheet, whose tangential part is a fraction of that of v (`of_thin_sheet`). The tangential quadratic term is halved
    because wires that cross at right angles have half the drag along their plane. The equations are solved implicitly,
    so that there is no stability limit; |w| is found by two iterations from the linear resistances.

    In a region without a thickness the normal is 0: it then resists all of the velocity, w = v, with the resistance
    across and half of the quadratic term.

    `normal` (3) is the unit normal of the screen, and `blood` the result of `rates`. `entry` holds the linear
    resistances along the normal and across it and the quadratic one along it, per cell and time step, and the `spread`
    of `of_thin_sheet`.
    """
    blood = blood[0], blood[1] * squared_reach(normal)
    through = u[0] * normal[0] + u[1] * normal[1] + u[2] * normal[2]
    across = larger(u[0] * u[0] + u[1] * u[1] + u[2] * u[2] - through * through, _ZERO)
    keep_along = _ONE / (_ONE + _HALF * entry[0])
    keep_across, beside = of_thin_sheet(entry[1], entry[3], keep_along * through, blood)
    for _ in range(2):
        size = root(beside * beside * across + keep_along * keep_along * through * through)
        keep_along = _ONE / (_ONE + _HALF * (entry[0] + entry[2] * size))
        keep_across, beside = of_thin_sheet(entry[1] + _HALF * entry[2] * size, entry[3], keep_along * through, blood)
    extra = (keep_along - keep_across) * through
    v = (
        keep_across * u[0] + extra * normal[0],
        keep_across * u[1] + extra * normal[1],
        keep_across * u[2] + extra * normal[2],
    )
    return v, (_TWO * (v[0] - u[0]), _TWO * (v[1] - u[1]), _TWO * (v[2] - u[2]))


@njit(cache=True, forceinline=True, error_model="numpy")
def collided(f: Any, time: Any, limit: Any, odd_rate: Any) -> tuple[Any, Any, Any]:
    """Return the collided parts from which `relaxed` computes populations without a screen."""
    density, u, flux = moments_of(f)
    keep, rate = _kept_and_rate(u, time, limit, odd_rate)
    n = departure(flux, u)
    momentum = rate * u[0], rate * u[1], rate * u[2]
    third = _third(u, n, keep - (_ONE - rate))
    squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    return _even(density, u, _plus_square(_times(keep, n), u), squared), _odd(momentum, third), _HALF * (_ONE - rate)


@njit(cache=True, forceinline=True, error_model="numpy")
def collided_screened(f: Any, time: Any, limit: Any, odd_rate: Any, normal: Any, entry: Any) -> tuple[Any, Any, Any]:
    """Return the collided parts of populations in a screen, from which `relaxed` computes them.

    The velocity includes half of the force. First and second moments of the force are multiplied by 1 - rate / 2.

    References
    ----------
    Guo, Zheng and Shi 2002, Phys. Rev. E 65, 046308, eq. 19 and 20.
    """
    density, bare, flux = moments_of(f)
    # The rate of slow flow is used, as in `d3q19.resisted`. With either rate the product of both times is near zero.
    u, force = resist(normal, entry, bare, rates(time, odd_rate))
    keep, rate = _kept_and_rate(u, time, limit, odd_rate)
    half, half_odd = _HALF + _HALF * keep, _ONE - _HALF * rate
    n = departure(flux, u)
    xx, yy, zz, xy, xz, yz = _plus_square(_times(keep, n), u)
    (x, y, z), (fx, fy, fz) = u, (half * force[0], half * force[1], half * force[2])
    pushed = (
        xx + _TWO * x * fx,
        yy + _TWO * y * fy,
        zz + _TWO * z * fz,
        xy + x * fy + y * fx,
        xz + x * fz + z * fx,
        yz + y * fz + z * fy,
    )
    momentum = (rate * x + half_odd * force[0], rate * y + half_odd * force[1], rate * z + half_odd * force[2])
    trace = pushed[0] + pushed[1] + pushed[2]
    odd = _odd(momentum, _third(u, n, keep - (_ONE - rate)))
    return _even(density, u, pushed, trace), odd, _HALF * (_ONE - rate)


@njit(cache=True, forceinline=True, error_model="numpy")
def rescaled(f: Any, stretch: Any, stress: Any) -> tuple[Any, ...]:
    """Return populations of the same flow for time steps `stretch` times as long, each in the place of its opposite.

    Speeds grow with the time step and densities with its square. The non-equilibrium of the odd part also grows with
    the square, because it is the density gradient. In a screen the momentum differs from that of the flow by half the
    force. This difference is not rescaled exactly, with an effect on a single step.

    `stretch` is the ratio of the new to the old time step, `stress` the product of it and the ratio of the relaxation
    times.

    References
    ----------
    Thuerey, Pohl, Ruede, Oechsner and Koerner 2006, Comput. Fluids 35, 934.
    """
    density, u, flux = moments_of(f)
    held = _times(stress, departure(flux, u))
    faster = stretch * u[0], stretch * u[1], stretch * u[2]
    added = (_ONE - stretch) * faster[0], (_ONE - stretch) * faster[1], (_ONE - stretch) * faster[2]
    zero = u[0] - u[0]
    squared = faster[0] * faster[0] + faster[1] * faster[1] + faster[2] * faster[2]
    even = _even(stretch * stretch * density, faster, _plus_square(held, faster), squared)
    return relaxed(f, even, _odd(added, (zero, zero, zero, zero, zero, zero)), _HALF * stretch * stretch)


@njit(cache=True, forceinline=True, error_model="numpy")
def carried(f: Any, squares: Any, ratio: Any, source: Any, target: Any) -> tuple[Any, ...]:
    """Return populations of the same flow on a grid of another spacing, each in the place of its opposite.

    Spacing and time step both change by `ratio`, so that speeds and densities are the same on both grids. The stress
    and the non-equilibrium of the odd part are differences per cell: they grow with `ratio` and with the relaxation
    time. In shear flow the density is too low by half the trace of the non-equilibrium, which is a squared difference
    per cell (Poiseuille flow: within 5 % at two spacings, speeds and viscosities).

    `squares` are the products u u of the velocity (6) that the momentum flux contains: those of interpolated
    populations differ from the products of their velocity. `source` and `target` hold the relaxation time of the
    stress, the largest grid Reynolds number and the relaxation rate of the odd part on both grids.

    References
    ----------
    Dupuis and Chopard 2003, Phys. Rev. E 67, 066707: rescaling of the non-equilibrium.
    """
    density, u, flux = moments_of(f)
    squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    xx, yy, zz = flux[0] - squares[0], flux[1] - squares[1], flux[2] - squares[2]
    trace = xx + yy + zz
    density = density + _HALF * (_ONE - ratio * ratio) * (trace - density)
    time, rate = _relaxation(squared, source[0], source[1], source[2])
    new_time, new_rate = _relaxation(squared, target[0], target[1], target[2])
    third = _THIRD * trace
    stress = xx - third, yy - third, zz - third, flux[3] - squares[3], flux[4] - squares[4], flux[5] - squares[5]
    held = _times(ratio * new_time / time, stress)
    kept = ratio * rate / new_rate
    eased, zero = _ONE - kept, u[0] - u[0]
    odd = _odd((eased * u[0], eased * u[1], eased * u[2]), (zero, zero, zero, zero, zero, zero))
    return relaxed(f, _even(density, u, _plus_square(held, u), squared), odd, _HALF * kept)
