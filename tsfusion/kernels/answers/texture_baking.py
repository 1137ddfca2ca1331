# SPDX-License-Identifier: MIT
"""Bake textures: the triangle and 3-D point of each texel, and its colour in the cameras' images.

Texel (column i, row j) has its centre at (i + 0.5, j + 0.5). A texel keeps the smallest `distance from the
triangle << 32 | triangle`, by an atomic minimum. Every other loop writes only to its own texel. Hence no
result depends on the order of threads.
"""

from tsfusion.kernels import F32, I32, U8, F32x2, F32x3, F64x2, I32x2, I64x2, ti, tm

NOBODY = (1 << 63) - 1
SUBTEXEL = 256.0  # units of distance per texel
_NEAR = 0.05  # metres ahead of a camera; nearer points are not visible


@ti.func
def row2(array: ti.template(), i, k):
    """Return corner k of triangle i as a 2-D vector (texture coordinates)."""
    return tm.vec2(array[i, k, 0], array[i, k, 1])


@ti.func
def row3(array: ti.template(), i):
    """Return row i of an array as a vector."""
    return tm.vec3(array[i, 0], array[i, 1], array[i, 2])


@ti.func
def along_edge(a, b, p):
    """Return the share (0 … 1) of the way from a to b at which the edge is nearest to point p."""
    d = b - a
    return tm.clamp(tm.dot(p - a, d) / ti.max(tm.dot(d, d), 1e-12), 0.0, 1.0)


@ti.func
def nearest_in_triangle(a, b, c, p):
    """Return the point of a triangle nearest to p as barycentric weights, and its distance (x, y, z,
    distance)."""
    area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
    wa = (b.x - p.x) * (c.y - p.y) - (b.y - p.y) * (c.x - p.x)
    wb = (c.x - p.x) * (a.y - p.y) - (c.y - p.y) * (a.x - p.x)
    wc = area - wa - wb
    found = tm.vec4(0.0, 0.0, 0.0, 0.0)
    if area < 0:  # a chart may be mirrored
        area, wa, wb, wc = -area, -wa, -wb, -wc
    if area > 0 and wa >= 0 and wb >= 0 and wc >= 0:
        found = tm.vec4(wa / area, wb / area, wc / area, 0.0)
    else:
        tab, tbc, tca = along_edge(a, b, p), along_edge(b, c, p), along_edge(c, a, p)
        dab = (a + tab * (b - a) - p).norm()
        dbc = (b + tbc * (c - b) - p).norm()
        dca = (c + tca * (a - c) - p).norm()
        found = tm.vec4(1.0 - tab, tab, 0.0, dab)
        if dbc < found.w:
            found = tm.vec4(0.0, 1.0 - tbc, tbc, dbc)
        if dca < found.w:
            found = tm.vec4(tca, 0.0, 1.0 - tca, dca)
    return found


@ti.kernel
def claim_texels(owner: I64x2, corners: F32x3, chosen: I32, reach: ti.f32):
    """Assign each texel near triangles of `chosen` (within `reach` texels) to the nearest one: fill `owner`
    (H, W), which holds NOBODY. `corners` (m, 3, 2) are in texels."""
    height, width = owner.shape[0], owner.shape[1]
    for index in range(chosen.shape[0]):
        f = chosen[index]
        a, b, c = row2(corners, f, 0), row2(corners, f, 1), row2(corners, f, 2)
        low = ti.floor(ti.min(ti.min(a, b), c) - reach)
        high = ti.ceil(ti.max(ti.max(a, b), c) + reach)
        for j in range(ti.max(ti.cast(low.y, ti.i32), 0), ti.min(ti.cast(high.y, ti.i32), height)):
            for i in range(ti.max(ti.cast(low.x, ti.i32), 0), ti.min(ti.cast(high.x, ti.i32), width)):
                near = nearest_in_triangle(a, b, c, tm.vec2(i + 0.5, j + 0.5))
                if near.w <= reach:
                    far = ti.cast(near.w * SUBTEXEL, ti.i64)
                    ti.atomic_min(owner[j, i], (far << 32) | ti.cast(f, ti.i64))


@ti.kernel
def mark_covered(owner: I64x2, corners: F32x3, chosen: I32, covered: U8):
    """Set `covered[f]` of each triangle that overlaps another one, which has a texel well inside it."""
    height, width = owner.shape[0], owner.shape[1]
    for index in range(chosen.shape[0]):
        f = chosen[index]
        a, b, c = row2(corners, f, 0), row2(corners, f, 1), row2(corners, f, 2)
        low = ti.floor(ti.min(ti.min(a, b), c))
        high = ti.ceil(ti.max(ti.max(a, b), c))
        for j in range(ti.max(ti.cast(low.y, ti.i32), 0), ti.min(ti.cast(high.y, ti.i32), height)):
            for i in range(ti.max(ti.cast(low.x, ti.i32), 0), ti.min(ti.cast(high.x, ti.i32), width)):
                if ti.cast(owner[j, i], ti.i32) != f:
                    near = nearest_in_triangle(a, b, c, tm.vec2(i + 0.5, j + 0.5))
                    if near.w == 0.0 and ti.min(ti.min(near.x, near.y), near.z) > 0.05:
                        covered[f] = ti.u8(1)


@ti.kernel
def place_texels(
    texels: I32x2, owner: I64x2, corners: F32x3, vertices: F32x2, normals: F32x2, faces: I32x2, points: F32x2,
    directions: F32x2,
):  # fmt: skip
    """Write the points and normals of the mesh at the texels `texels` (n, 2), given as row and column."""
    for r in range(texels.shape[0]):
        j, i = texels[r, 0], texels[r, 1]
        f = ti.cast(owner[j, i], ti.i32)
        at = nearest_in_triangle(
            row2(corners, f, 0), row2(corners, f, 1), row2(corners, f, 2), tm.vec2(i + 0.5, j + 0.5)
        )
        p, n = tm.vec3(0.0), tm.vec3(0.0)
        for k in ti.static(range(3)):
            p += at[k] * row3(vertices, faces[f, k])
            n += at[k] * row3(normals, faces[f, k])
        n /= ti.max(n.norm(), 1e-9)
        for k in ti.static(range(3)):
            points[r, k] = p[k]
            directions[r, k] = n[k]


@ti.func
def bilinear(image: ti.template(), u, v, k):
    """Interpolate channel k of an image between its pixels; (u, v) is at least a pixel inside."""
    i, j = ti.cast(ti.floor(u), ti.i32), ti.cast(ti.floor(v), ti.i32)
    s, t = u - i, v - j
    above = (1.0 - s) * image[j, i, k] + s * image[j, i + 1, k]
    below = (1.0 - s) * image[j + 1, i, k] + s * image[j + 1, i + 1, k]
    return (1.0 - t) * above + t * below


@ti.func
def moved(T: ti.template(), p):
    """Transform point p by the 4×4 matrix T."""
    q = tm.vec3(0.0)
    for k in ti.static(range(3)):
        q[k] = ti.cast(T[k, 0] * p.x + T[k, 1] * p.y + T[k, 2] * p.z + T[k, 3], ti.f32)
    return q


@ti.func
def pixel(K: ti.template(), p):
    """Project point p (camera frame) to column and row of the image."""
    return tm.vec2(K[0] * p.x / p.z + K[2], K[1] * p.y / p.z + K[3])


@ti.func
def is_inside(at, height, width):
    """Return True if a pixel position lies between four pixel centres of the image."""
    return at.x >= 1.0 and at.y >= 1.0 and at.x < width - 2.0 and at.y < height - 2.0


@ti.kernel
def look(
    points: F32x2, normals: F32x2, T: F64x2, T_color: F64x2, K: F32, depth: F32x2, clearness: F32x2,
    tolerance: ti.f32, relative: ti.f32, least_cosine: ti.f32, found: F32x2,
):  # fmt: skip
    """Write each point's column, row and quality in a camera image to `found` (n, 3); 0 = not visible.

    A point is visible if the image's depth is within `tolerance + relative · z` of the point's depth: nothing
    occludes the surface, and it existed then. The quality is the number of pixels per square metre of the
    surface, times the pixel's clearness. `T` (4, 4) is T_camera_world. `T_color` is the same for the colours,
    which may be from another moment than the depth. `K` is fx, fy, cx, cy.
    """
    height, width = depth.shape[0], depth.shape[1]
    for r in range(points.shape[0]):
        world, normal = row3(points, r), row3(normals, r)
        p = moved(T, world)
        n = tm.vec3(0.0)
        for k in ti.static(range(3)):
            n[k] = ti.cast(T[k, 0] * normal.x + T[k, 1] * normal.y + T[k, 2] * normal.z, ti.f32)
        at, quality = tm.vec2(0.0), 0.0
        cosine = -tm.dot(p, n) / ti.max(p.norm(), 1e-9)
        if p.z > _NEAR and cosine > least_cosine:
            at = pixel(K, p)
            if is_inside(at, height, width):
                z = depth[ti.cast(at.y + 0.5, ti.i32), ti.cast(at.x + 0.5, ti.i32)]
                if z > 0.0 and ti.abs(z - p.z) <= tolerance + relative * p.z:
                    i, j = ti.cast(ti.floor(at.x), ti.i32), ti.cast(ti.floor(at.y), ti.i32)
                    clear = ti.min(
                        ti.min(clearness[j, i], clearness[j, i + 1]),
                        ti.min(clearness[j + 1, i], clearness[j + 1, i + 1]),
                    )
                    seen = moved(T_color, world)
                    at = pixel(K, seen)
                    if seen.z > _NEAR and is_inside(at, height, width):
                        quality = K[0] * ti.abs(K[1]) / (p.z * p.z) * cosine * clear
        found[r, 0], found[r, 1], found[r, 2] = at.x, at.y, quality


@ti.kernel
def blend(found: F32x2, bands: F32x3, unit: ti.f32, power: ti.f32, sums: F32x2):
    """Add an image's colours at each texel to `sums` (n, 8): Σ of weight and coarse colour, then fine.

    `bands` (H, W, 7) has the image's coarse part, its fine part, and its trust. Coarse colours are mixed by
    quality, which hides seams. The weight of fine colours is a power of the quality, which favours the best
    views. `unit` is the quality with weight 1.
    """
    for r in range(found.shape[0]):
        u, v = found[r, 0], found[r, 1]
        if found[r, 2] > 0.0:
            quality = found[r, 2] / unit * bilinear(bands, u, v, 6)
            sharp = quality**power
            sums[r, 0] += quality
            sums[r, 4] += sharp
            for k in ti.static(range(3)):
                sums[r, 1 + k] += quality * bilinear(bands, u, v, k)
                sums[r, 5 + k] += sharp * bilinear(bands, u, v, 3 + k)
