# SPDX-License-Identifier: MIT
"""Rasterise triangles with a z-buffer: find the triangle that each pixel sees, and shade images.

Vertices are in camera coordinates (x right, y down, z forward). A pixel keeps the smallest `depth bits << 32
| triangle`, by an atomic minimum: the image does not depend on thread order. Back faces are not drawn, which
shows rooms from outside without their near walls.
"""

from tsfusion.kernels import F32x2, F32x3, I32x2, I64x2, U8x2, U8x3, ti, tm
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of

EMPTY = (1 << 63) - 1
OVERLAP = 5e-4  # pixels added to a triangle's width: rounding leaves no gap between neighbours
STRIPS = 64  # of rows of the image: units of parallel work
TAPS = 14  # samples around a pixel for its ambient occlusion
FLAT = 0.08  # sine of a rise, up to noise, that does not darken
GOLDEN = 2.399963  # angle between taps of a spiral, radians (Vogel 1979)


@ti.func
def corner(vertices: ti.types.ndarray(), i):
    """Return row i of an array as a vector."""
    return tm.vec3(vertices[i, 0], vertices[i, 1], vertices[i, 2])


@ti.func
def cut(a, b, near):
    """Return the point where the edge from a (ahead of the near plane) to b (behind it) meets that plane."""
    t = (near - a.z) / (b.z - a.z)
    return tm.vec3(a.x + t * (b.x - a.x), a.y + t * (b.y - a.y), near)


@ti.func
def edge(a, b, p):
    """Return twice the signed area of the triangle a, b, p in the image."""
    return (b.x - a.x) * (p.y - a.y) - (b.y - a.y) * (p.x - a.x)


@ti.func
def fill(seen: ti.types.ndarray(), a, b, c, triangle, focal, width, height):
    """Write one triangle, completely ahead of the near plane, into the z-buffer `seen`."""
    centre = tm.vec2(0.5 * (width - 1), 0.5 * (height - 1))
    pa = centre + focal * a.xy / a.z
    pb = centre + focal * b.xy / b.z
    pc = centre + focal * c.xy / c.z
    area = edge(pa, pb, pc)
    low = ti.ceil(tm.max(ti.min(ti.min(pa, pb), pc), 0.0))
    high = ti.floor(ti.min(ti.max(ti.max(pa, pb), pc), tm.vec2(width - 1, height - 1)))
    if area != 0.0 and low.x <= high.x and low.y <= high.y:
        # Shares of the corners, and 1 / depth, are linear in the image: values at `low`, and steps.
        share = 1.0 / area
        w = tm.vec3(edge(pb, pc, low), edge(pc, pa, low), edge(pa, pb, low)) * share
        right = tm.vec3(pb.y - pc.y, pc.y - pa.y, pa.y - pb.y) * share
        down = tm.vec3(pc.x - pb.x, pa.x - pc.x, pb.x - pa.x) * share
        least = -OVERLAP * (ti.abs(right) + ti.abs(down))
        inverse = tm.vec3(1.0 / a.z, 1.0 / b.z, 1.0 / c.z)
        per_right = 1.0 / right
        u0 = ti.cast(low.x, ti.i32)
        for v in range(ti.cast(low.y, ti.i32), ti.cast(high.y, ti.i32) + 1):
            row = w + down * (ti.cast(v, ti.f32) - low.y)
            first, last = ti.f32(0.0), high.x - low.x
            for k in ti.static(range(3)):
                bound = (least[k] - row[k]) * per_right[k]
                if right[k] > 0.0:
                    first = ti.max(first, bound)
                elif right[k] < 0.0:
                    last = ti.min(last, bound)
                elif row[k] < least[k]:
                    last = -1.0
            near = tm.dot(row, inverse)
            nearer = tm.dot(right, inverse)
            # Floats first, since an int cannot hold the result of a nearly level edge; then ints, since NaN
            # is possible.
            wide = high.x - low.x
            start = ti.max(ti.cast(ti.ceil(ti.min(first, wide + 1.0)), ti.i32), 0)
            stop = ti.min(ti.cast(ti.floor(ti.max(last, -1.0)), ti.i32), ti.cast(wide, ti.i32))
            for n in range(start, stop + 1):
                per_depth = near + nearer * ti.cast(n, ti.f32)
                bits = ti.cast(ti.bit_cast(ti.cast(1.0 / per_depth, ti.f32), ti.i32), ti.i64)
                key = (bits << 32) | ti.cast(triangle, ti.i64)
                if per_depth > 0.0 and key < seen[v, u0 + n]:
                    ti.atomic_min(seen[v, u0 + n], key)


@QuickLaunch
@ti.kernel
def rasterise(seen: I64x2, vertices: F32x2, faces: I32x2, focal: ti.f32, near: ti.f32):
    """Fill the z-buffer `seen` (H, W), EMPTY before, from `vertices` (n, 3) and `faces` (m, 3)."""
    height, width = seen.shape[0], seen.shape[1]
    for f in range(faces.shape[0]):
        a = corner(vertices, faces[f, 0])
        b = corner(vertices, faces[f, 1])
        c = corner(vertices, faces[f, 2])
        facing = tm.dot(tm.cross(b - a, c - a), a)
        if facing < 0.0:  # the triangle's normal points towards the eye
            in_front = 0
            for k in ti.static(range(3)):
                in_front += ti.cast(vertices[faces[f, k], 2] >= near, ti.i32)
            # Rotate the triangle until the corner that differs from the others is the first.
            for _ in range(2):
                odd = (a.z >= near) if in_front == 1 else (a.z < near)
                if (in_front == 1 or in_front == 2) and not odd:
                    d = a
                    a = b
                    b = c
                    c = d
            if in_front == 3:
                fill(seen, a, b, c, f, focal, width, height)
            elif in_front == 2:
                ab = cut(b, a, near)
                ac = cut(c, a, near)
                fill(seen, ab, b, c, f, focal, width, height)
                fill(seen, ab, c, ac, f, focal, width, height)
            elif in_front == 1:
                fill(seen, a, cut(a, b, near), cut(a, c, near), f, focal, width, height)


@ti.func
def opposite(a, b, c):
    """Return normals, as rows, of the planes through the eye and the side opposite each triangle corner."""
    return ti.Matrix.rows([tm.cross(b, c), tm.cross(c, a), tm.cross(a, b)])


@ti.func
def shares(edges, ray):
    """Return barycentric coordinates where a ray meets a triangle's plane (Möller and Trumbore 1997)."""
    w = edges @ ray
    total = w.sum()
    if total != 0.0:
        w *= 1.0 / total
    else:
        w = tm.vec3(1.0, 0.0, 0.0)
    return tm.clamp(w, 0.0, 1.0)


@ti.kernel
def look_up(
    seen: I64x2, vertices: F32x2, faces: I32x2,
    normals: F32x2,  # of no rows: none wanted
    colors: U8x2,  # likewise
    focal: ti.f32, empty: ti.i64, depth: F32x2, normal: F32x3, color: U8x3,
):  # fmt: skip
    """Write depth (m), unit normal and colour of each pixel with a triangle in `seen`, from its corners."""
    height, width = seen.shape[0], seen.shape[1]
    per_pixel = 1.0 / focal
    is_more = normals.shape[0] + colors.shape[0] > 0
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            last = -1  # triangle
            edges, towards, tints = tm.mat3(0.0), tm.mat3(0.0), tm.mat3(0.0)
            for v in range(height * strip // STRIPS, height * (strip + 1) // STRIPS):
                y = (v - 0.5 * (height - 1)) * per_pixel
                for u in range(width):
                    key = seen[v, u]
                    if key != empty:
                        depth[v, u] = ti.bit_cast(ti.cast(key >> 32, ti.i32), ti.f32)
                    if key != empty and is_more:
                        f = ti.cast(key, ti.i32)  # the low half
                        if f != last:
                            last = f
                            ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
                            edges = opposite(corner(vertices, ia), corner(vertices, ib), corner(vertices, ic))
                            for k in ti.static(range(3)):
                                if normals.shape[0] > 0:
                                    towards[k, :] = tm.vec3(normals[ia, k], normals[ib, k], normals[ic, k])
                                if colors.shape[0] > 0:
                                    tints[k, :] = tm.vec3(colors[ia, k], colors[ib, k], colors[ic, k])
                        w = shares(edges, tm.vec3((u - 0.5 * (width - 1)) * per_pixel, y, 1.0))
                        if normals.shape[0] > 0:
                            n = towards @ w
                            n *= 1.0 / ti.max(n.norm(), 1e-9)
                            for k in ti.static(range(3)):
                                normal[v, u, k] = n[k]
                        if colors.shape[0] > 0:
                            tint = tints @ w
                            for k in ti.static(range(3)):
                                color[v, u, k] = ti.cast(tint[k] + 0.5, ti.u8)


@QuickLaunch
@ti.kernel
def shade(
    image: F32x3, seen: I64x2, vertices: F32x2, faces: I32x2, normals: F32x2, colors: U8x2, focal: ti.f32,
    up_x: ti.f32, up_y: ti.f32, up_z: ti.f32, empty: ti.i64,
):  # fmt: skip
    """Write `image` (H, W, 4): linear RGB in 0…1 and depth in metres, where `seen` is not EMPTY.

    `normals` and `up` are in camera coordinates; `colors` (n, 3) are sRGB. A lamp at the eye shows shapes. A
    hemisphere around `up` distinguishes floors from walls.
    """
    height, width = seen.shape[0], seen.shape[1]
    for v, u in ti.ndrange(height, width):
        if seen[v, u] != empty:
            f = ti.cast(seen[v, u], ti.i32)  # the low half
            ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
            a, b, c = corner(vertices, ia), corner(vertices, ib), corner(vertices, ic)
            ray = tm.vec3((u - 0.5 * (width - 1)) / focal, (v - 0.5 * (height - 1)) / focal, 1.0)
            wa, wb, wc = shares(opposite(a, b, c), ray)
            normal = wa * corner(normals, ia) + wb * corner(normals, ib) + wc * corner(normals, ic)
            normal /= ti.max(normal.norm(), 1e-9)
            facing = ti.max(-tm.dot(normal, ray) / ray.norm(), 0.0)
            sky = 0.5 + 0.5 * tm.dot(normal, tm.vec3(up_x, up_y, up_z))
            light = 0.25 + 0.45 * facing + 0.35 * sky
            for k in ti.static(range(3)):
                color = (wa * colors[ia, k] + wb * colors[ib, k] + wc * colors[ic, k]) / 255.0
                image[v, u, k] = ti.min(light * color**2.2, 1.0)
            image[v, u, 3] = wa * a.z + wb * b.z + wc * c.z


@ti.func
def point_at(image: ti.types.ndarray(), v, u, focal):
    """Return the point that a pixel sees, in camera coordinates; z = 0 if the pixel is empty."""
    x = (u - 0.5 * (image.shape[1] - 1)) / focal
    y = (v - 0.5 * (image.shape[0] - 1)) / focal
    return image[v, u, 3] * tm.vec3(x, y, 1.0)


@ti.func
def step_between(image: ti.types.ndarray(), v, u, dv, du, focal):
    """Return the 3-D vector along the surface from pixel (v, u) to its neighbour (v + dv, u + du), or from
    the opposite neighbour to the pixel, if that is less steep."""
    height, width = image.shape[0], image.shape[1]
    here = point_at(image, v, u, focal)
    ahead = point_at(image, ti.min(v + dv, height - 1), ti.min(u + du, width - 1), focal) - here
    behind = here - point_at(image, ti.max(v - dv, 0), ti.max(u - du, 0), focal)
    has_ahead = v + dv < height and u + du < width
    has_behind = v >= dv and u >= du
    return ahead if has_ahead and (not has_behind or abs(ahead.z) <= abs(behind.z)) else behind


@ti.kernel
def occlude(image: F32x3, samples: ti.i32, focal: ti.f32, radius: ti.f32, strength: ti.f32):
    """Darken `image` (H, W, 4), in place, where surfaces within `radius` metres hide the sky.

    This is ambient occlusion from depths alone (McGuire et al., "The alchemy screen-space ambient obscurance
    algorithm", 2011), computed once per `samples`² pixels.
    """
    height, width = image.shape[0], image.shape[1]
    for i, j in ti.ndrange(height // samples, width // samples):
        v, u = i * samples, j * samples
        here = point_at(image, v, u, focal)
        if here.z > 0.0:
            normal = tm.cross(step_between(image, v, u, 1, 0, focal), step_between(image, v, u, 0, 1, focal))
            normal /= ti.max(normal.norm(), 1e-12)
            reach = ti.min(focal * radius / here.z, 0.2 * width)  # pixels
            hidden = 0.0
            for k in range(TAPS):
                far = reach * ti.sqrt((k + 0.5) / TAPS)
                y = v + ti.cast(ti.round(far * ti.sin(GOLDEN * k)), ti.i32)
                x = u + ti.cast(ti.round(far * ti.cos(GOLDEN * k)), ti.i32)
                if 0 <= y < height and 0 <= x < width and image[y, x, 3] > 0.0:
                    way = point_at(image, y, x, focal) - here
                    length = way.norm()
                    if 0.0 < length < radius:
                        rise = tm.dot(way, normal) / length
                        hidden += ti.max(rise - FLAT, 0.0) * (1.0 - length / radius)
            light = ti.max(1.0 - strength * hidden / TAPS, 0.0)
            for y, x, c in ti.static(ti.ndrange(2, 2, 3)):
                if y < samples and x < samples:
                    image[v + y, u + x, c] *= light
