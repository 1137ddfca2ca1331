// SPDX-License-Identifier: MIT
// The 3-D view of a report: WebGL 2 and nothing else. Drag turns, Shift or the right button moves, the wheel zooms.
"use strict";

const VERTEX = `#version 300 es
in vec3 place, normal, color;
in float level;
uniform mat4 view;
uniform vec3 low, size, up, eye;
uniform vec2 heights;
uniform int mode;
uniform sampler2D ramp;
out vec3 paint, side, ray;
vec3 map(float x) { return texture(ramp, vec2(clamp(x, 0.0, 1.0) * 0.996 + 0.002, 0.5)).rgb; }
void main() {
  vec3 p = low + place * size;
  if (mode == 1) paint = map((dot(p, up) - heights.x) / (heights.y - heights.x));
  else if (mode == 2) paint = 0.5 + 0.5 * normal;
  else if (mode == 3) paint = vec3(0.78);
  else if (mode == 4) paint = map(level);
  else paint = color;
  side = normal;
  ray = p - eye;
  gl_Position = view * vec4(p, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 paint, side, ray;
uniform vec3 up;
uniform bool flat_;
uniform float alpha;
out vec4 result;
void main() {
  if (flat_) { result = vec4(0.90, 0.38, 0.0, 1.0); return; }
  vec3 n = normalize(side) * (gl_FrontFacing ? 1.0 : -1.0);
  float light = 0.28 + 0.45 * max(-dot(n, normalize(ray)), 0.0) + 0.35 * (0.5 + 0.5 * dot(n, up));
  result = vec4(pow(min(pow(paint, vec3(2.2)) * light, 1.0), vec3(1.0 / 2.2)), alpha);
}`;

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// What `scene.Scene.packed` put together.
function decode(bytes, head) {
  const n = head.vertices, m = 3 * head.triangles;
  let at = 0;
  const take = (count) => bytes.subarray(at, (at += count));
  const place = new Uint16Array(3 * n), words = take(6 * n);
  for (let axis = 0; axis < 3; axis++)
    for (let i = 0, sum = 0; i < n; i++) {
      const k = 2 * (axis * n + i);
      place[3 * i + axis] = sum = (sum + words[k] + 256 * words[k + 1]) & 65535;
    }
  const faces = new Uint32Array(m), planes = take(4 * m);
  for (let i = 0, sum = 0; i < m; i++)
    faces[i] = sum = (sum + planes[i] + (planes[m + i] << 8) + (planes[2 * m + i] << 16) + (planes[3 * m + i] << 24)) >>> 0;
  const turned = (source, type) => {
    const result = new type(3 * n);
    for (let i = 0; i < n; i++) for (let axis = 0; axis < 3; axis++) result[3 * i + axis] = source[axis * n + i];
    return result;
  };
  const normal = turned(take(3 * n), Int8Array);
  const color = head.colors ? turned(take(3 * n), Uint8Array) : new Uint8Array(3 * n).fill(200);
  return { place, faces, normal, color, level: head.error ? take(n) : new Uint8Array(n) };
}

class Viewer {
  constructor(box, head, mesh, ramp) {
    this.canvas = box.querySelector("canvas");
    const gl = (this.gl = this.canvas.getContext("webgl2", { antialias: true, stencil: true }));
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.head = head;
    this.up = head.up;
    const east = Math.abs(dot(this.up, [0, 1, 0])) < 0.9 ? [0, 1, 0] : [1, 0, 0];
    this.east = unit(cross(this.up, east));
    this.north = cross(this.up, this.east);
    this.reach = 0.5 * Math.hypot(...head.size);
    this.mode = head.colors ? 0 : 1;
    this.sample = [];  // places that the first view shows, but for strays
    for (let i = 0; i < head.vertices; i += Math.ceil(head.vertices / 2000))
      this.sample.push([0, 1, 2].map((axis) => head.low[axis] + (head.size[axis] * mesh.place[3 * i + axis]) / 65535));
    this.build(mesh, ramp);
    this.home(head.azimuth, head.elevation);
    this.listen(box);
    new ResizeObserver(() => this.ask()).observe(this.canvas);
  }

  home(azimuth = this.first[0], elevation = this.first[1]) {
    this.first = [azimuth, elevation];
    [this.azimuth, this.elevation] = this.first;
    const [right, forward, upward] = this.axes(), [fx, fy] = this.focal(), places = this.sample;
    // The nearest eye from which 98 % of the places are in the picture, side by side and one above the other.
    const ends = (axis, k, sign) => places.map((p) => dot(p, axis) + (sign * dot(p, forward) * 0.9) / k).sort((a, b) => a - b);
    const outer = (values, share) => values[Math.round(share * (values.length - 1))];
    const fit = (axis, k) => {
      const low = outer(ends(axis, k, 1), 0.01), high = outer(ends(axis, k, -1), 0.99);
      return [(low + high) / 2, ((low - high) / 2) * (k / 0.9)];  // middle, and how far forward the eye stands
    };
    const [x, zx] = fit(right, fx), [y, zy] = fit(upward, fy), z = Math.min(zx, zy);
    const middle = places.map((p) => dot(p, forward)).sort((a, b) => a - b)[places.length >> 1];
    this.distance = Math.max(middle - z, 0.1 * this.reach);
    this.target = [0, 1, 2].map((i) => x * right[i] + y * upward[i] + middle * forward[i]);
    this.ask();
  }

  build(mesh, ramp) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    ["place", "normal", "color", "level"].forEach((name, i) => gl.bindAttribLocation(program, i, name));
    gl.linkProgram(program);
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    const buffer = (kind, values) => {
      gl.bindBuffer(kind, gl.createBuffer());
      gl.bufferData(kind, values, gl.STATIC_DRAW);
    };
    const attribute = (index, values, size, type) => {
      buffer(gl.ARRAY_BUFFER, values);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, size, type, true, 0, 0);
    };
    this.arrays = [gl.createVertexArray(), gl.createVertexArray()];
    gl.bindVertexArray(this.arrays[0]);
    attribute(0, mesh.place, 3, gl.UNSIGNED_SHORT);
    attribute(1, mesh.normal, 3, gl.BYTE);
    attribute(2, mesh.color, 3, gl.UNSIGNED_BYTE);
    attribute(3, mesh.level, 1, gl.UNSIGNED_BYTE);
    buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces);
    gl.bindVertexArray(this.arrays[1]);
    const share = (p) => p.map((x, axis) => (x - this.head.low[axis]) / this.head.size[axis]);
    attribute(0, new Float32Array((this.head.path || []).flatMap(share)), 3, gl.FLOAT);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, Uint8Array.from(ramp));
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, gl.LINEAR);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
  }

  listen(box) {
    const canvas = this.canvas, down = new Map();
    let span = 0;
    const moved = (event, dx, dy) => {
      if (down.size > 1 || event.shiftKey || event.buttons & 6) this.move(dx, dy);
      else this.turn(-0.006 * dx, 0.006 * dy);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, [event.clientX, event.clientY]);
      span = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = down.get(event.pointerId);
      if (!before) return;
      down.set(event.pointerId, [event.clientX, event.clientY]);
      moved(event, (event.clientX - before[0]) / down.size, (event.clientY - before[1]) / down.size);
      if (down.size === 2) {
        const [a, b] = [...down.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (span) this.zoom(span / now);
        span = now;
      }
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => down.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(0.0012 * event.deltaY)); }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", () => this.home());
    canvas.addEventListener("keydown", (event) => {
      const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      if (keys[event.key]) this.turn(...keys[event.key]);
      else if (event.key === "+" || event.key === "-") this.zoom(event.key === "+" ? 0.9 : 1.1);
      else return;
      event.preventDefault();
    });
    const paint = box.querySelector("select"), walls = box.querySelector("input");
    paint.value = String(this.mode);
    paint.addEventListener("change", () => { this.mode = Number(paint.value); this.ask(); });
    walls.addEventListener("change", () => { this.walls = walls.checked; this.ask(); });
    box.querySelector("button").addEventListener("click", () => this.home());
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.min(1.55, Math.max(-1.55, this.elevation + elevation));
    this.ask();
  }

  zoom(factor) {
    this.distance = Math.min(20 * this.reach, Math.max(0.005 * this.reach, this.distance * factor));
    this.ask();
  }

  move(dx, dy) {
    const [right, , upward] = this.axes(), metres = this.distance / (1.2 * this.canvas.clientHeight);
    this.target = plus(plus(this.target, right, -dx * metres), upward, dy * metres);
    this.ask();
  }

  axes() {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    const level = plus(this.east.map((x) => ca * x), this.north, sa);
    const forward = plus(level.map((x) => -ce * x), this.up, -se);
    const right = unit(cross(forward, this.up));
    return [right, forward, cross(right, forward)];
  }

  focal() {  // of a narrow view: little perspective
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return w > h ? [(2.4 * h) / w, 2.4] : [2.4, (2.4 * w) / h];
  }

  ask() {
    if (this.asked || !this.arrays) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(); });
  }

  draw() {
    const gl = this.gl, canvas = this.canvas, scale = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    gl.viewport(0, 0, canvas.width, canvas.height);
    const paper = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).map((x) => x / 255);
    gl.clearColor(paper[0], paper[1], paper[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    const [right, forward, upward] = this.axes(), eye = plus(this.target, forward, -this.distance);
    const far = this.distance + 3 * this.reach, near = Math.max(0.01 * this.distance, far * 2e-4);
    const [fx, fy] = this.focal();
    const a = (far + near) / (far - near), b = -2 * far * near / (far - near);
    const row = (axis, k) => [axis[0] * k, axis[1] * k, axis[2] * k, -dot(axis, eye) * k];
    const z = row(forward, 1), rows = [row(right, fx), row(upward, fy), [a * z[0], a * z[1], a * z[2], a * z[3] + b], z];
    gl.uniformMatrix4fv(this.at("view"), false, [0, 1, 2, 3].flatMap((c) => rows.map((r) => r[c])));
    gl.uniform3fv(this.at("low"), this.head.low);
    gl.uniform3fv(this.at("size"), this.head.size);
    gl.uniform3fv(this.at("up"), this.up);
    gl.uniform3fv(this.at("eye"), eye);
    gl.uniform2fv(this.at("heights"), this.head.heights);
    gl.uniform1i(this.at("mode"), this.mode);
    gl.uniform1i(this.at("flat_"), 0);
    gl.bindVertexArray(this.arrays[0]);
    const draw = (culled, alpha, front) => {  // what there is a front for is marked
      gl.cullFace(culled);
      gl.stencilFunc(culled === gl.BACK ? gl.ALWAYS : gl.EQUAL, front, 1);
      gl.depthMask(alpha === 1);
      gl.uniform1f(this.at("alpha"), alpha);
      gl.drawElements(gl.TRIANGLES, 3 * this.head.triangles, gl.UNSIGNED_INT, 0);
      gl.depthMask(true);
    };
    draw(gl.BACK, 1, 1);
    draw(gl.FRONT, this.walls ? 1 : 0.15, 1);  // before a front, backs are glass: poles stay, and rooms are open
    draw(gl.FRONT, 1, 0);
    gl.stencilFunc(gl.ALWAYS, 1, 1);
    gl.uniform1i(this.at("flat_"), 1);
    gl.bindVertexArray(this.arrays[1]);
    gl.drawArrays(gl.LINE_STRIP, 0, (this.head.path || []).length);
    canvas.dispatchEvent(new Event("drawn", { bubbles: true }));
  }
}

for (const box of document.querySelectorAll(".viewer")) {
  const head = JSON.parse(box.querySelector(".head").textContent);
  const ramp = JSON.parse(document.getElementById("ramp").textContent);
  unpacked(box.querySelector(".packed").textContent)
    .then((bytes) => new Viewer(box, head, decode(bytes, head), ramp))
    .catch((error) => { box.querySelector(".trouble").textContent = `No 3-D view: ${error.message}. The pictures show the same.`; });
}
