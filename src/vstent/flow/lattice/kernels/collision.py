"""What one collision does to the 19 populations of a cell: arithmetic alone, for one cell or for as many as Lanes hold.

Every number may be a float32 or `vstent.flow.lattice.kernels.lanes`. Populations are shifted by their rest weights
and numbered as in `vstent.flow.lattice.kernels.d3q19`.

Regularised: of the even part only the stress survives (Latt and Chopard 2006, Math. Comput. Simul. 72:165, eq 12),
without its trace, which only carries sound. The odd part has its own rate (Ginzburg, Verhaeghe and d'Humieres 2008,
Commun. Comput. Phys. 3, 427), in fast blood a higher one (`_stable_rate`). Equilibrium of incompressible flow (He and
Luo 1997, J. Stat. Phys. 88, 927, eq. 20): the steady state is free of divergence, whatever the lattice speed.

Two moments that nineteen velocities lack are made up for, and both bend a round jet along the grid's diagonals. The
fourth moments are those that the second ones ask for, <xxyy> = density / 9 + (ux ux + uy uy) / 3 (Bauer and Ruede 2018,
arXiv:1803.04937, sec. 3): the usual equilibrium of D3Q19 lacks uz uz / 6 there. And <xxyz> cannot be held at all: what
advection makes of the stress by it, d/dz of a sixth of (uz n_xz + ...), is put into the third moments (`_third`).
"""

from typing import Any

import numpy as np
from numba import njit

from vstent.flow.lattice.kernels.lanes import larger, root

_THIRD, _AXIS, _DIAGONAL = np.float32(1 / 3), np.float32(1 / 18), np.float32(1 / 36)
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX, _EIGHT = (
    np.float32(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
)
_THREE_HALVES, _QUARTER, _EIGHTH, _TWELFTH, _TWENTY_FOURTH, _TINY = (
    np.float32(x) for x in (3 / 2, 1 / 4, 1 / 8, 1 / 12, 1 / 24, 1e-12)
)


@njit(cache=True, forceinline=True, error_model="numpy")
def moments_of(f: Any) -> tuple[Any, Any, Any]:
    """Density deviation, momentum (3) and momentum flux xx, yy, zz, xy, xz, yz of the populations."""
    s1, s2, s3 = f[1] + f[2], f[3] + f[4], f[5] + f[6]
    s4, s5, s6 = f[7] + f[8], f[9] + f[10], f[11] + f[12]
    s7, s8, s9 = f[13] + f[14], f[15] + f[16], f[17] + f[18]
    d1, d2, d3 = f[1] - f[2], f[3] - f[4], f[5] - f[6]
    d4, d5, d6 = f[7] - f[8], f[9] - f[10], f[11] - f[12]
    d7, d8, d9 = f[13] - f[14], f[15] - f[16], f[17] - f[18]
    density = f[0] + s1 + s2 + s3 + s4 + s5 + s6 + s7 + s8 + s9
    momentum = d1 + d4 + d5 + d6 + d7, d2 + d4 - d5 + d8 + d9, d3 + d6 - d7 + d8 - d9
    diagonal = s1 + s4 + s5 + s6 + s7, s2 + s4 + s5 + s8 + s9, s3 + s6 + s7 + s8 + s9
    return density, momentum, (*diagonal, s4 - s5, s6 - s7, s8 - s9)


@njit(cache=True, forceinline=True, error_model="numpy")
def departure(flux: Any, u: Any) -> tuple[Any, ...]:
    """Stress (6): what the momentum flux has beyond u u, without its trace, which only carries sound."""
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
    """Third moments xyy, xzz, xxy, yzz, xxz, yyz of velocity and stress, in the place of a moment <xxyz>.

    A `part` of them, in quarters: what each adds to the odd half of four diagonal pairs.
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
def _even(density: Any, u: Any, flux: Any) -> tuple[Any, ...]:
    """What the rest population and, in each of the nine pairs, half of both are to be (10): see `relaxed_pair`.

    From the density deviation, the velocity (3) and the second moments wanted (6).
    """
    xx, yy, zz, xy, xz, yz = flux
    isotropic = density - _THREE_HALVES * (xx + yy + zz)
    wx, wy, wz = _THREE_HALVES * u[0] * u[0], _THREE_HALVES * u[1] * u[1], _THREE_HALVES * u[2] * u[2]
    pxy = _DIAGONAL * (isotropic + wz) + _EIGHTH * (xx + yy)
    pxz = _DIAGONAL * (isotropic + wy) + _EIGHTH * (xx + zz)
    pyz = _DIAGONAL * (isotropic + wx) + _EIGHTH * (yy + zz)
    return (
        _THIRD * (isotropic + _THIRD * (wx + wy + wz)),
        _AXIS * (isotropic - wy - wz) + _QUARTER * xx,
        _AXIS * (isotropic - wx - wz) + _QUARTER * yy,
        _AXIS * (isotropic - wx - wy) + _QUARTER * zz,
        pxy + _QUARTER * xy,
        pxy - _QUARTER * xy,
        pxz + _QUARTER * xz,
        pxz - _QUARTER * xz,
        pyz + _QUARTER * yz,
        pyz - _QUARTER * yz,
    )


@njit(cache=True, forceinline=True, error_model="numpy")
def _odd(momentum: Any, third: Any) -> tuple[Any, ...]:
    """What is added to half the difference of each of the nine pairs: see `relaxed_pair`.

    From the momentum (3) added, and the third moments, in quarters (6).
    """
    x, y, z = _TWELFTH * momentum[0], _TWELFTH * momentum[1], _TWELFTH * momentum[2]
    xyy, xzz, xxy, yzz, xxz, yyz = third
    return (
        _TWO * (x - (xyy + xzz)),
        _TWO * (y - (xxy + yzz)),
        _TWO * (z - (xxz + yyz)),
        (x + y) + (xyy + xxy),
        (x - y) + (xyy - xxy),
        (x + z) + (xzz + xxz),
        (x - z) + (xzz - xxz),
        (y + z) + (yzz + yyz),
        (y - z) + (yzz - yyz),
    )


@njit(cache=True, forceinline=True, error_model="numpy")
def relaxed_pair(a: Any, b: Any, even: Any, odd: Any, half_kept: Any) -> tuple[Any, Any]:
    """Return collided populations in place of a and b, its opposite: already swapped.

    `even` and `odd` are the pair's of what `collided` returns, `half_kept` what it returns besides.
    """
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
def _stable_rate(squared: Any, time: Any, odd_rate: Any) -> Any:
    """Relaxation rate of the odd part: `odd_rate`, or as much higher as blood of this squared speed is stable with.

    Waves on a uniform flow grow where its squared speed times (1 / rate - 1/2) passes some twice the viscosity: there
    an eigenvalue of collision and streaming passes 1 (von Neumann's analysis, rates from 0.7 to 1.7; along the grid's
    axes first). Up to three quarters of that are allowed, with which nothing grows up to a speed of 0.2.
    """
    slow = _ONE / odd_rate
    excess = larger((slow - _HALF) * squared - _HALF * (time - _HALF), _ZERO)
    return squared / (slow * squared - excess)


@njit(cache=True, forceinline=True, error_model="numpy")
def _kept_and_rate(u: Any, time: Any, limit: Any, odd_rate: Any) -> tuple[Any, Any]:
    """Part of the stress kept, by the blood's relaxation time or at the largest cell Reynolds number, and odd rate."""
    squared = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + _TINY
    time = larger(time, _HALF + _THREE / limit * root(squared))
    return _ONE - _ONE / time, _stable_rate(squared, time, odd_rate)


@njit(cache=True, forceinline=True, error_model="numpy")
def stress_size(f: Any) -> Any:
    """Norm of the stress that populations hold, times the root of two."""
    _, u, flux = moments_of(f)
    xx, yy, zz, xy, xz, yz = departure(flux, u)
    return root(_TWO * (xx * xx + yy * yy + zz * zz + _TWO * (xy * xy + xz * xz + yz * yz)))


@njit(cache=True, forceinline=True, fastmath=True, error_model="numpy")
def thinned(size: Any, time: Any, law: Any) -> Any:
    """Relaxation time of blood that thins with the shear rate, from its `stress_size`; one number, never Lanes.

    Strain rate = 1.5 / time of the second moments' departure from equilibrium (Boyd, Buick and Green 2006, J. Phys. A
    39, 14241, eq. 9), which depends on the time sought: three rounds from blood at rest. `law` as in `lattice.update`.
    """
    found = time + law[0]
    for _ in range(3):
        rate = _THREE_HALVES * size / found
        found = time + law[0] * (_ONE + (law[1] * rate) ** law[2]) ** law[3]
    return found


@njit(cache=True, forceinline=True, error_model="numpy")
def rates(time: Any, odd_rate: Any) -> tuple[Any, Any]:
    """Viscosity, and by how much the product of the two relaxation times, less a half each, falls short of 1/4."""
    even = time - _HALF
    return even * _THIRD, larger(_QUARTER - (_ONE / odd_rate - _HALF) * even, _ZERO)


@njit(cache=True, forceinline=True, error_model="numpy")
def squared_reach(normal: Any) -> Any:
    """How far along a unit normal the links reach that carry momentum across it, squared: 1 at most, 1/2 at least.

    The sum of w c_n^4 c_t^2 over that of w c_n^2 c_t^2, mean of both tangents t, over the velocities c of D3Q19.
    """
    x, y, z = normal[0] * normal[0], normal[1] * normal[1], normal[2] * normal[2]
    return _THREE - _EIGHT * (x * x + y * y + z * z) + _SIX * (x * x * x + y * y * y + z * z * z)


@njit(cache=True, forceinline=True, error_model="numpy")
def of_thin_sheet(across: Any, spread: Any, through: Any, blood: Any) -> tuple[Any, Any]:
    """Part of the speed along a thin sheet that is left where a cell's share of it resists by `across`.

    In the cell's half-force velocity, and in the sheet itself. A thin sheet brakes blood that has been slowed on its
    way there, down to the speed that it leaves with. Parts a and b of it in two layers of cells, d apart, brake twice:
    R + a b d R R / stir for R, where momentum goes from one to the other at the rate stir = viscosity + |u_n| / 2;
    `spread` is a b d R of all layers, R the whole sheet's. And where a lattice is pushed by F its velocity stands out
    by (1/4 - L) F / stir along an axis of the grid, by the `squared_reach` of that elsewhere, L being the product of
    the relaxation times less a half each (the second difference of the force: Ginzburg, Silva and Talon 2015, Phys.
    Rev. E 91, 023307): with L far below 1/4 a dense braid would take twice what it should. `blood` is the viscosity and
    how much the velocity so stands out.
    """
    viscosity, shortfall = blood
    stir = viscosity + _HALF * larger(through, _ZERO - through)
    # The sheet's speed over the lattice's is 2 stir / open: all in one division, for divisions are what this costs.
    open = stir + root(stir * (stir + _FOUR * spread)) + _TWO * shortfall * across
    free = _ONE / (open + stir * across)
    return open * free, _TWO * stir * free


@njit(cache=True, forceinline=True, error_model="numpy")
def resist(normal: Any, entry: Any, u: Any, blood: Any) -> tuple[Any, Any]:
    """Half-force velocity v inside a screen, and the force, from the velocity u without it: v = u + F / 2.

    `entry` holds the linear resistance along the unit normal and across it, and the quadratic one along it, all per
    cell and time step, and the `spread`: F = -(along + quadratic size) v_n n - (across + quadratic size / 2) w_t, for
    wires that cross at right angles are dragged half as much along their plane; w is the velocity in a thin sheet,
    along it a part of v (`of_thin_sheet`), and size is |w|. Solved at once but for |w|, which is found in two rounds
    from what the linear resistances leave: no stability limit.
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
    """Return what `relaxed` makes populations of that collide freely.

    The even parts (10), the odd ones (9), and half of how much of the odd part is kept.
    """
    density, u, flux = moments_of(f)
    keep, rate = _kept_and_rate(u, time, limit, odd_rate)
    n = departure(flux, u)
    momentum = rate * u[0], rate * u[1], rate * u[2]
    third = _third(u, n, keep - (_ONE - rate))
    return _even(density, u, _plus_square(_times(keep, n), u)), _odd(momentum, third), _HALF * (_ONE - rate)


@njit(cache=True, forceinline=True, error_model="numpy")
def collided_screened(f: Any, time: Any, limit: Any, odd_rate: Any, normal: Any, entry: Any) -> tuple[Any, Any, Any]:
    """Return the same of populations in a screen (see `resist`).

    The force of Guo, Zheng and Shi 2002 (Phys. Rev. E 65, 046308, eq. 19 and 20): velocity with half the force, and the
    force's first and second moment with the factors 1 - rate / 2.
    """
    density, bare, flux = moments_of(f)
    # With the rate of slow blood, as `lattice.resisted` reads it: the product of both times is near zero with either.
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
    momentum = (
        rate * x + half_odd * force[0],
        rate * y + half_odd * force[1],
        rate * z + half_odd * force[2],
    )
    return _even(density, u, pushed), _odd(momentum, _third(u, n, keep - (_ONE - rate))), _HALF * (_ONE - rate)


@njit(cache=True, forceinline=True, error_model="numpy")
def rescaled(f: Any, stretch: Any, stress: Any) -> tuple[Any, ...]:
    """Return populations of the same flow in time steps `stretch` times as long, each in the place of its opposite.

    Of `f` (19,), an array: speeds grow with the step, densities with its square, as does what the odd part has beyond
    its equilibrium, for that is the density's gradient; the stress grows with the step times its relaxation time, by
    `stress` (Thuerey, Pohl, Ruede, Oechsner and Koerner 2006, Comput. Fluids 35, 934). The momentum in a screen
    is not that of the flow, by half the force: as little is it carried over, for a step.
    """
    density, u, flux = moments_of(f)
    held = _times(stress, departure(flux, u))
    faster = stretch * u[0], stretch * u[1], stretch * u[2]
    added = (_ONE - stretch) * faster[0], (_ONE - stretch) * faster[1], (_ONE - stretch) * faster[2]
    zero = u[0] - u[0]
    even = _even(stretch * stretch * density, faster, _plus_square(held, faster))
    return relaxed(f, even, _odd(added, (zero, zero, zero, zero, zero, zero)), _HALF * stretch * stretch)
