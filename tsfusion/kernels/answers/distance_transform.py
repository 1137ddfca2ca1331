# SPDX-License-Identifier: MIT
"""Compute the exact Euclidean distance transform of a box of voxels, one axis at a time.

The algorithm is that of Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions" (2012), in
integers. Each line of voxels gets the lower envelope of one parabola per site. The number of the nearest site
is kept with the smallest squared distance; among equally far sites the smallest number counts. Hence neither
the order of the axes nor the surroundings of a box change the result.

Grids are flat arrays of (X, Y, Z), z fastest. A site is a voxel at the surface.
"""

from tsfusion.kernels import F32, I32, F32x2, I32x3, ti
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.voxel_traversal import vec3i

STRIPS = 64  # units of parallel work; fixed, so that no result depends on the thread count
FAR = 1 << 30  # squared distance without a site in reach
NONE = -1  # number of a missing site
_LEAD = 0.5  # gain of the distance per voxel towards a neighbouring surface

vec2i = ti.types.vector(2, ti.i32)
vec3f = ti.types.vector(3, ti.f32)


@ti.func
def value_at(values: ti.template(), shape, at):
    """Return the signed distance (in voxels) that grid `values` holds at voxel `at`; NaN outside the grid."""
    value = ti.math.nan
    if (
        at[0] >= 0 and at[1] >= 0 and at[2] >= 0
        and at[0] < shape[0] and at[1] < shape[1] and at[2] < shape[2]
    ):  # fmt: skip
        value = values[(at[0] * shape[1] + at[1]) * shape[2] + at[2]]
    return value


@ti.func
def is_site(values: ti.template(), shape, at, own):
    """Return 1 if voxel `at` is a site: the surface is within half a voxel of its centre, or between it and a
    neighbour that is not nearer to the surface."""
    found = 0
    if ti.abs(own) <= 0.5:
        found = 1
    elif not ti.math.isnan(own):
        for a in ti.static(range(3)):
            for side in ti.static((-1, 1)):
                other = at
                other[a] += side
                value = value_at(values, shape, other)  # a comparison with NaN is false
                if (value < 0.0) != (own < 0.0) and ti.abs(own) <= ti.abs(value):
                    found = 1
    return found


@ti.func
def is_rim(values: ti.template(), shape, at, own):
    """Return True if a body ends at voxel `at`, beside an unseen voxel, and no neighbour leads to a surface.

    Example: the edge of a table in a slice through its top; its surface is above, not at the side.
    """
    beside, lead = 0, 0.0
    if own < -0.5:
        for a in ti.static(range(3)):
            most = own
            for side in ti.static((-1, 1)):
                other = at
                other[a] += side
                if other[a] >= 0 and other[a] < shape[a]:
                    value = value_at(values, shape, other)
                    if ti.math.isnan(value):
                        beside = 1
                    elif value > most:
                        most = value
            lead += (most - own) ** 2
    return beside == 1 and lead < _LEAD**2


@ti.func
def slope(values: ti.template(), shape, at, own):
    """Return the gradient of the distance, per voxel. On an axis that crosses the surface it is the
    difference across the surface, else the central difference of seen neighbours."""
    gradient = vec3f(0.0)
    for a in ti.static(range(3)):
        step = vec3i(0)
        step[a] = 1
        up, down = value_at(values, shape, at + step) - own, own - value_at(values, shape, at - step)
        if ti.math.isnan(up):
            up = down
        if ti.math.isnan(down):
            down = up
        if not ti.math.isnan(up):
            gradient[a] = 0.5 * (up + down)
            crosses_up, crosses_down = (own + up < 0.0) != (own < 0.0), (own - down < 0.0) != (own < 0.0)
            if crosses_up and (not crosses_down or ti.abs(up) >= ti.abs(down)):
                gradient[a] = up
            elif crosses_down:
                gradient[a] = down
    return gradient


@ti.func
def surface_offset(values: ti.template(), shape, at):
    """Return the vector, voxels, from a site's centre (a surface voxel) to the surface: at most one voxel."""
    own = value_at(values, shape, at)
    gradient = slope(values, shape, at, own)
    offset = gradient * (-own / ti.max(gradient.norm_sqr(), 1e-6))
    return offset / ti.max(1.0, offset.norm())


@QuickLaunch
@ti.kernel
def mark_sites(
    values: F32, X: ti.i32, Y: ti.i32, Z: ti.i32, first: ti.i32, end: ti.i32, rims: ti.i32, squared: I32,
    nearest: I32,
):  # fmt: skip
    """Start a transform in rows `first` ≤ x < `end` of the grid `values`: `squared` is 0 at sites, else FAR.

    With `rims`, voxels where a solid body ends beside unseen space are sites, too.
    """
    for row in range((end - first) * Y):
        x, y = first + row // Y, row % Y
        for z in range(Z):
            i = (x * Y + y) * Z + z
            squared[i], nearest[i] = FAR, NONE
            shape, at, own = vec3i(X, Y, Z), vec3i(x, y, z), values[i]
            if is_site(values, shape, at, own) or (rims == 1 and is_rim(values, shape, at, own)):
                squared[i], nearest[i] = 0, i


@ti.func
def last_place(p, g_p, site_p, q, g_q, site_q):
    """Return the last index on a line that is nearer to the site at index `p` than to the site at `q`."""
    num = (g_q + q * q) - (g_p + p * p)
    den = 2 * (q - p)
    last = ti.floor(num / ti.cast(den, ti.f64), ti.i32)
    if last * den == num and site_q < site_p:
        last -= 1
    return last


@QuickLaunch
@ti.kernel
def spread_along_lines(
    squared: I32, nearest: I32, length: ti.i32, inner: ti.i32, first_line: ti.i32, last_line: ti.i32,
    begin: ti.i32, end: ti.i32, most: ti.i32, stack: I32x3, out_squared: I32, out_nearest: I32,
):  # fmt: skip
    """Write the smallest squared distance to a site for indices `begin` … `end` − 1 of each line of the grid.

    The grid is (…, `length`, `inner`); in the output a line has `end` − `begin` voxels. Squared distances
    above `most` are far. `stack` (bands, length, 2) has, for each parabola on the envelope, its index and the
    first index at which it counts.
    """
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            count = last_line - first_line
            for line in range(
                first_line + count * strip // STRIPS, first_line + count * (strip + 1) // STRIPS
            ):
                outer, within = line // inner, line % inner
                here = outer * length * inner + within
                top = -1
                for q in range(length):
                    g_q, site_q = squared[here + q * inner], nearest[here + q * inner]
                    if g_q < FAR:
                        start, pops = 0, 1
                        while pops == 1 and top >= 0:
                            p = stack[strip, top, 0]
                            i = here + p * inner
                            start = last_place(p, squared[i], nearest[i], q, g_q, site_q) + 1
                            pops = 0
                            if start <= stack[strip, top, 1]:
                                top -= 1
                                start, pops = 0, 1
                        if start < end:
                            top += 1
                            stack[strip, top, 0], stack[strip, top, 1] = q, start
                into = outer * (end - begin) * inner + within
                k = 0
                for x in range(begin, end):
                    best, site = FAR, NONE
                    if top >= 0:
                        while k < top and stack[strip, k + 1, 1] <= x:
                            k += 1
                        p = stack[strip, k, 0]
                        best = squared[here + p * inner] + (x - p) * (x - p)
                        site = nearest[here + p * inner]
                        if best > most:
                            best, site = FAR, NONE
                    out_squared[into + (x - begin) * inner] = best
                    out_nearest[into + (x - begin) * inner] = site


@QuickLaunch
@ti.kernel
def place_sites(values: F32, shape: vec3i, squared: I32, rows: vec2i, columns: vec2i, offsets: F32x2):
    """Write `offsets`: for each site (`squared` is 0) in `rows` of x and `columns` of y, the vector in voxels
    from its centre to the surface; 0 at a rim."""
    width = columns[1] - columns[0]
    for n in range((rows[1] - rows[0]) * width):
        x, y = rows[0] + n // width, columns[0] + n % width
        for z in range(shape[2]):
            i = (x * shape[1] + y) * shape[2] + z
            if squared[i] == 0:
                at = vec3i(x, y, z)
                offset = vec3f(0.0)
                if is_site(values, shape, at, values[i]):
                    offset = surface_offset(values, shape, at)
                for a in ti.static(range(3)):
                    offsets[i, a] = offset[a]


@QuickLaunch
@ti.kernel
def measure(
    values: F32, shape: vec3i, begin: vec3i, extent: vec3i, squared: I32, nearest: I32, rows: vec2i,
    columns: vec2i, subvoxel: ti.i32, placed: ti.i32, offsets: F32x2, edge: ti.f32, most: ti.f32,
    distances: F32,
):  # fmt: skip
    """Write signed `distances` in metres, at most `most`, negative behind the surface, for the voxels in
    `rows` of x and `columns` of y (first, end) of the box `begin`, `extent`. A distance leads to the surface
    at the nearest site (`subvoxel`), or to the centre of this site.

    `edge` is a voxel's edge, metres. With `placed` the surface is at the `offsets` of `place_sites`, which
    saves work because many voxels share one site.
    """
    width = columns[1] - columns[0]
    for n in range((rows[1] - rows[0]) * width):
        x, y = rows[0] + n // width, columns[0] + n % width
        for z in range(extent[2]):
            i = (x * extent[1] + y) * extent[2] + z
            place = begin + vec3i(x, y, z)
            distance = most
            site = nearest[i]
            if site >= 0 and subvoxel == 0:
                distance = ti.min(ti.sqrt(ti.cast(squared[i], ti.f32)) * edge, most)
            elif site >= 0:
                at = vec3i(site // (shape[1] * shape[2]), site // shape[2] % shape[1], site % shape[2])
                foot = ti.cast(at - place, ti.f32)
                if placed == 1:
                    foot += vec3f(offsets[site, 0], offsets[site, 1], offsets[site, 2])
                else:
                    foot += surface_offset(values, shape, at)
                distance = ti.min(foot.norm() * edge, most)
            own = value_at(values, shape, place)
            distances[i] = ti.select(own < 0.0, -distance, distance)
