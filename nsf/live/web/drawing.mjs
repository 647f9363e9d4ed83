// Points, their shadows, the floor and solids, in WebGL 2.

import { placed, acts } from "./solids.mjs";

/** @typedef {import("./camera.mjs").Camera} Camera */
/** @typedef {import("./data.mjs").Numbers} Numbers */
/** @typedef {import("./solids.mjs").Solid} Solid */
/** @typedef {{ use: () => void, uniform: (name: string) => WebGLUniformLocation | null, attribute: (name: string) => number }} Program */

const NO_WEBGL = "This browser has no WebGL 2; switch on hardware acceleration, or try another browser.";

const POINTS = [
  `#version 300 es
in vec3 x, rest; in float value;
uniform mat4 view; uniform vec3 offset, middle; uniform vec2 across;
uniform float pixels, floorHeight; uniform bool shadow, cut;
out float shade;
void main() {
  if (cut && dot(rest.xy - middle.xy, across) > 0.0) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  shade = value;
  vec3 at = x + offset;
  if (shadow) at = vec3(at.xy + 0.35 * (at.z - floorHeight) * vec2(0.8, 0.5), floorHeight);
  gl_Position = view * vec4(at, 1.0);
  gl_PointSize = max(1.5, pixels / gl_Position.w);
}`,
  `#version 300 es
precision mediump float;
in float shade; uniform sampler2D colors; uniform bool shadow; uniform vec3 dark; out vec4 pixel;
void main() {
  vec2 p = 2.0 * gl_PointCoord - 1.0;
  float r = dot(p, p);
  if (r > 1.0) discard;
  if (shadow) { pixel = vec4(dark, 1.0); return; }
  vec3 normal = vec3(p.x, -p.y, sqrt(1.0 - r));
  float light = 0.70 + 0.34 * max(0.0, dot(normal, normalize(vec3(-0.45, 0.65, 0.62))));
  vec3 color = texture(colors, vec2(clamp(shade, 0.0, 1.0) * 0.996 + 0.002, 0.5)).rgb;
  pixel = vec4(light * mix(color, vec3(1.0), 0.06), 1.0);
}`,
];
const FLOOR = [
  `#version 300 es
in vec2 corner; uniform mat4 view; uniform vec3 centre; uniform float reach; out vec2 away;
void main() { away = corner; gl_Position = view * vec4(centre.xy + reach * corner, centre.z, 1.0); }`,
  `#version 300 es
precision mediump float;
in vec2 away; uniform vec3 near, far; out vec4 pixel;
void main() { pixel = vec4(mix(near, far, smoothstep(0.1, 1.0, length(away))), 1.0); }`,
];
const SOLID = [
  `#version 300 es
in vec3 x, normal; uniform mat4 view, pose; uniform vec3 extents; uniform bool ball; out float light;
void main() {
  vec3 turned = mat3(pose) * (ball ? normal : normalize(normal / max(extents, vec3(1e-9))));
  light = 0.75 + 0.25 * dot(turned, normalize(vec3(0.3, -0.5, 0.8)));
  gl_Position = view * pose * vec4(extents * x, 1.0);
}`,
  `#version 300 es
precision mediump float;
in float light; uniform vec4 tint; out vec4 pixel;
void main() { pixel = vec4(light * tint.rgb, 1.0) * tint.a; }`,
];

/**
 * @param {WebGL2RenderingContext} gl
 * @param {string[]} sources of the vertex and the fragment shader
 * @returns {Program}
 */
function program(gl, sources) {
  const made = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, k) => {
    const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
    gl.shaderSource(shader, sources[k]);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) ?? "no program");
  /** @type {Map<string, any>} */
  const found = new Map();
  const once = (/** @type {string} */ name, /** @type {() => any} */ find) => {
    if (!found.has(name)) found.set(name, find());
    return found.get(name);
  };
  return {
    use: () => gl.useProgram(made),
    uniform: (name) => once(name, () => gl.getUniformLocation(made, name)),
    attribute: (name) => once(name, () => gl.getAttribLocation(made, name)),
  };
}

/** Triangles of a box with half edges of one: corner and normal of each. */
function box() {
  const found = [];
  for (const axis of [0, 1, 2])
    for (const side of [-1, 1])
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
        const x = [0, 0, 0], normal = [0, 0, 0];
        x[axis] = normal[axis] = side;
        x[(axis + 1) % 3] = u;
        x[(axis + 2) % 3] = v;
        found.push(...x, ...normal);
      }
  return new Float32Array(found);
}

/** Triangles of a ball of radius one. */
function ball(rings = 16) {
  const at = (/** @type {number} */ i, /** @type {number} */ j) => {
    const [a, b] = [(Math.PI * i) / rings, (Math.PI * j) / rings];
    return [Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)];
  };
  const found = [];
  for (let i = 0; i < rings; i++)
    for (let j = 0; j < 2 * rings; j++)
      for (const [u, v] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) {
        const x = at(i + u, j + v);
        found.push(...x, ...x);
      }
  return new Float32Array(found);
}

/** A body of points. */
class Body {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Numbers} rest [n, 3] [m]
   * @param {number} radius of a point [m]
   * @param {number[]} offset [3] [m] by which all are drawn aside
   */
  constructor(gl, rest, radius, offset) {
    this.count = rest.length / 3;
    this.radius = radius;
    this.offset = offset;
    this.visible = true;
    this._gl = gl;
    this.rest = gl.createBuffer();
    this.x = gl.createBuffer();
    this.value = gl.createBuffer();
    this._fill(this.rest, Float32Array.from(rest));
    this.show(Float32Array.from(rest), new Float32Array(this.count));
  }

  /**
   * @param {Float32Array} x [n, 3] [m]
   * @param {Float32Array} values [n] over the end of their scale
   */
  show(x, values) {
    this._fill(this.x, x);
    this._fill(this.value, values);
  }

  /** @param {WebGLBuffer} buffer @param {Float32Array} values */
  _fill(buffer, values) {
    this._gl.bindBuffer(this._gl.ARRAY_BUFFER, buffer);
    this._gl.bufferData(this._gl.ARRAY_BUFFER, values, this._gl.DYNAMIC_DRAW);
  }
}

/** What a canvas shows. */
export class Drawing {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Camera} camera
   * @param {{ colors: number[], floor: number | null, radius: number }} told
   * @throws {Error} in words for a reader, where there is no WebGL 2
   */
  constructor(canvas, camera, told) {
    const gl = canvas.getContext("webgl2", { antialias: false }); // the points' edges, which are discarded, gain nothing
    if (!gl) throw new Error(NO_WEBGL);
    this.gl = gl;
    this.canvas = canvas;
    this.camera = camera;
    this.floor = told.floor;
    this.radius = told.radius;
    this.cut = false;
    this.time = 0;
    this.shadows = true;
    this.fine = 1; // share of the screen's pixels along a side
    /** @type {Solid[]} */ this.solids = [];
    /** @type {Body[]} */ this.bodies = [];
    this.points = program(gl, POINTS);
    this.plane = program(gl, FLOOR);
    this.solid = program(gl, SOLID);
    this.corners = this._buffer(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    this.shapes = { box: this._shape(box()), ball: this._shape(ball()) };
    this._colors(told.colors);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /**
   * Another body.
   * @param {Numbers} rest [n, 3] [m]
   * @param {number[]} [offset] [3] [m]
   * @param {number} [radius] of its points [m]
   */
  body(rest, offset = [0, 0, 0], radius = this.radius) {
    const made = new Body(this.gl, rest, radius, offset);
    this.bodies.push(made);
    return made;
  }

  /** Draw all. */
  draw() {
    const { gl, canvas, camera } = this, ratio = this.fine * (window.devicePixelRatio || 1);
    const [wide, tall] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
    if (canvas.width !== wide || canvas.height !== tall) Object.assign(canvas, { width: wide, height: tall });
    const back = this._back(), matrix = camera.view(wide / tall);
    gl.viewport(0, 0, wide, tall);
    gl.clearColor(back[0], back[1], back[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const toned = (/** @type {number} */ by) => back.map((v) => (v > 0.5 ? v - by : v + by));
    if (this.floor !== null) this._floor(matrix, toned(0.065), back);
    this._points(matrix, camera.pixels(wide, tall), toned(0.195));
    if (this.solids.length) this._solids(matrix);
  }

  /** Draw less from now on, where a browser draws too slowly: first no shadows, then fewer pixels. */
  coarsen() {
    if (!this.shadows && this.fine > 0.4) this.fine *= 0.7;
    this.shadows = false;
  }

  /** @param {Float32Array} matrix @param {number[]} near @param {number[]} far */
  _floor(matrix, near, far) {
    const { gl, plane, camera } = this;
    plane.use();
    gl.uniformMatrix4fv(plane.uniform("view"), false, matrix);
    const [x, y] = [0, 1].map((c) => 0.5 * (camera.lower[c] + camera.upper[c]));
    gl.uniform3f(plane.uniform("centre"), x, y, this.floor ?? 0);
    gl.uniform1f(plane.uniform("reach"), 2 * camera.size);
    gl.uniform3fv(plane.uniform("near"), near);
    gl.uniform3fv(plane.uniform("far"), far);
    this._attribute(plane, "corner", this.corners, 2);
    gl.depthMask(false);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.depthMask(true);
  }

  /** @param {Float32Array} matrix @param {number} pixels @param {number[]} dark */
  _points(matrix, pixels, dark) {
    const { gl, points, camera } = this;
    points.use();
    gl.uniformMatrix4fv(points.uniform("view"), false, matrix);
    gl.uniform3fv(points.uniform("middle"), camera.lower.map((v, c) => 0.5 * (v + camera.upper[c])));
    gl.uniform2f(points.uniform("across"), 0.47, -0.88);
    gl.uniform1f(points.uniform("floorHeight"), this.floor ?? 0);
    gl.uniform3fv(points.uniform("dark"), dark);
    gl.uniform1i(points.uniform("cut"), Number(this.cut));
    for (const shadow of this.floor === null || !this.shadows ? [0] : [1, 0]) {
      gl.uniform1i(points.uniform("shadow"), shadow);
      gl.depthMask(!shadow);
      for (const body of this.bodies) {
        if (!body.visible) continue;
        gl.uniform1f(points.uniform("pixels"), 2 * pixels * body.radius);
        gl.uniform3fv(points.uniform("offset"), body.offset);
        this._attribute(points, "x", body.x, 3);
        this._attribute(points, "rest", body.rest, 3);
        this._attribute(points, "value", body.value, 1);
        gl.drawArrays(gl.POINTS, 0, body.count);
      }
    }
    gl.depthMask(true);
  }

  /** @param {Float32Array} matrix */
  _solids(matrix) {
    const { gl, solid: shader, camera } = this;
    shader.use();
    gl.uniformMatrix4fv(shader.uniform("view"), false, matrix);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    for (const solid of this.solids) {
      if (!acts(solid, this.time)) continue;
      const pose = placed(solid, this.time);
      let extents = solid.extents;
      if (solid.shape === "half-space") {
        // A floor is drawn as such; a wall is a thin plate.
        if (solid.extents[2] > 0.99) continue;
        wall(pose, solid.extents, camera);
        extents = [0.25 * camera.size, 0.25 * camera.size, 1e-3 * camera.size];
      }
      const round = solid.shape === "sphere", shape = round ? this.shapes.ball : this.shapes.box;
      if (round) extents = [0, 1, 2].map(() => solid.extents[0]);
      gl.uniformMatrix4fv(shader.uniform("pose"), false, pose);
      gl.uniform3fv(shader.uniform("extents"), extents);
      gl.uniform1i(shader.uniform("ball"), Number(round));
      gl.uniform4f(shader.uniform("tint"), 0.45, 0.52, 0.62, 0.45);
      this._attribute(shader, "x", shape.buffer, 3, 24, 0);
      this._attribute(shader, "normal", shape.buffer, 3, 24, 12);
      gl.drawArrays(gl.TRIANGLES, 0, shape.count);
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }

  /** The page's background, as the style has it now. */
  _back() {
    const found = getComputedStyle(document.body).backgroundColor.match(/[\d.]+/g) ?? ["255", "255", "255"];
    return found.slice(0, 3).map((v) => Number(v) / 255);
  }

  /** @param {Float32Array} values */
  _buffer(values) {
    const { gl } = this, made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return made;
  }

  /** @param {Float32Array} values of corners and normals */
  _shape(values) {
    return { buffer: this._buffer(values), count: values.length / 6 };
  }

  /** @param {number[]} colors [256 × 3] of 8 bits */
  _colors(colors) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const size = /** @type {const} */ ([gl.RGB8, colors.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE]);
    gl.texImage2D(gl.TEXTURE_2D, 0, ...size, new Uint8Array(colors));
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
    for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
      gl.texParameteri(gl.TEXTURE_2D, wrap, gl.CLAMP_TO_EDGE);
  }

  /**
   * @param {Program} shader
   * @param {string} name
   * @param {WebGLBuffer} buffer
   * @param {number} components
   * @param {number} stride
   * @param {number} offset
   */
  _attribute(shader, name, buffer, components, stride = 0, offset = 0) {
    const { gl } = this, at = shader.attribute(name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, components, gl.FLOAT, false, stride, offset);
  }
}

/**
 * Turn a wall's pose so that its third axis is its normal, and put it beside the scene's middle.
 * @param {Float32Array} pose [16] by columns, changed in place
 * @param {number[]} normal
 * @param {Camera} camera
 */
function wall(pose, normal, camera) {
  const middle = camera.lower.map((v, c) => 0.5 * (v + camera.upper[c]));
  const off = normal.reduce((sum, v, c) => sum + v * (middle[c] - pose[12 + c]), 0);
  const flat = Math.abs(normal[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const one = unit(cross(flat, normal)), two = cross(normal, one);
  [one, two, normal].forEach((axis, j) => axis.forEach((v, c) => { pose[4 * j + c] = v; }));
  middle.forEach((v, c) => { pose[12 + c] = v - off * normal[c]; });
}

/** @param {number[]} a @param {number[]} b */
function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** @param {number[]} a */
function unit(a) {
  const size = Math.hypot(...a);
  return a.map((v) => v / size);
}
