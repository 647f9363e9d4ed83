// Points, their shadows, the floor and solids, in WebGL 2.

import { Body, SLANT } from "./body.mjs";
import { placed, acts } from "./solids.mjs";

/** @typedef {import("./camera.mjs").Camera} Camera */
/** @typedef {import("./data.mjs").Numbers} Numbers */
/** @typedef {import("./body.mjs").Cut} Cut */
/** @typedef {import("./solids.mjs").Solid} Solid */
/** @typedef {{ use: () => void, uniform: (name: string) => WebGLUniformLocation | null, attribute: (name: string) => number }} Program */

const NO_WEBGL = "This browser has no WebGL 2; switch on hardware acceleration, or try another browser.";

const SLOW = 40; // [ms] between two pictures, above which they are drawn coarser
const OFTEN = 4; // such pictures in a row
const REST = 250; // [ms] after which what stands still is drawn whole
const COARSEST = 3;
const MOST_PIXELS = 2; // of the canvas along one of the page; a telephone's three cost twice as much

const POINTS = [
  `#version 300 es
in vec4 point; uniform mat4 view; uniform float pixels; uniform vec4 tint; uniform sampler2D colors; flat out vec3 color;
void main() {
  vec3 scaled = point.w < 0.0 ? vec3(0.73) : textureLod(colors, vec2(clamp(point.w, 0.0, 1.0) * 0.996 + 0.002, 0.5), 0.0).rgb;
  color = mix(mix(scaled, vec3(1.0), 0.06), tint.rgb, tint.a);
  gl_Position = view * vec4(point.xyz, 1.0);
  gl_PointSize = max(1.5, pixels / gl_Position.w);
}`,
  `#version 300 es
precision mediump float;
flat in vec3 color; uniform bool shadow; uniform vec3 dark; out vec4 pixel;
void main() {
  vec2 p = 2.0 * gl_PointCoord - 1.0;
  float r = dot(p, p);
  if (r > 1.0) discard;
  if (shadow) { pixel = vec4(dark, 1.0); return; }
  vec3 normal = vec3(p.x, -p.y, sqrt(1.0 - r));
  float light = 0.70 + 0.34 * max(0.0, dot(normal, normalize(vec3(-0.45, 0.65, 0.62))));
  pixel = vec4(light * color, 1.0);
}`,
];
const SURFACE = [
  `#version 300 es
in vec3 x, normal; in float value; uniform mat4 view; uniform vec3 sun, dark; uniform vec2 slant; uniform float ground;
uniform bool shadow; uniform sampler2D colors; out vec3 color;
void main() {
  vec3 at = shadow ? vec3(x.xy + slant * (x.z - ground), ground) : x;
  vec3 scaled = textureLod(colors, vec2(clamp(value, 0.0, 1.0) * 0.996 + 0.002, 0.5), 0.0).rgb;
  color = shadow ? dark : (0.6 + 0.42 * max(0.0, dot(normal, sun))) * mix(scaled, vec3(1.0), 0.06);
  gl_Position = view * vec4(at, 1.0);
}`,
  `#version 300 es
precision mediump float;
in vec3 color; out vec4 pixel;
void main() { pixel = vec4(color, 1.0); }`,
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
        x[(axis + 1) % 3] = side * u; // anticlockwise as it is seen from outside
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

/** What a canvas shows. */
export class Drawing {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Camera} camera
   * @param {{ colors: number[], floor: number | null, radius: number }} told
   * @throws {Error} in words for a reader, where there is no WebGL 2
   */
  constructor(canvas, camera, told) {
    // Edges of points, which are discarded, gain nothing from antialiasing; a canvas that lets through is costly to blend.
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error(NO_WEBGL);
    this.gl = gl;
    this.canvas = canvas;
    this.camera = camera;
    this.scene = { lower: camera.lower, upper: camera.upper }; // without a body beside it
    this.floor = told.floor;
    this.radius = told.radius;
    this.cut = false;
    this.time = 0;
    this.level = 0; // 0 draws all; then without shadows, then with fewer pixels each
    /** @type {Solid[]} */ this.solids = [];
    /** @type {Body[]} */ this.bodies = [];
    this.points = program(gl, POINTS);
    this.surface = program(gl, SURFACE);
    this.plane = program(gl, FLOOR);
    this.solid = program(gl, SOLID);
    this.drawn = gl.createBuffer();
    this.faces = gl.createBuffer();
    this.corners = this._buffer(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    this.shapes = { box: this._shape(box()), ball: this._shape(ball()) };
    this.scale = gl.createTexture();
    this.paint(told.colors);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /**
   * Another body.
   * @param {Numbers} rest [n, 3] [m]
   * @param {number[]} [offset] [3] [m]
   * @param {number} [radius] of its points [m]
   * @param {number[] | null} [tint] [3] one colour for all of its points
   */
  body(rest, offset = [0, 0, 0], radius = this.radius, tint = null) {
    const made = new Body(rest, radius, offset, tint);
    this.bodies.push(made);
    return made;
  }

  /** Draw all. */
  draw() {
    const { gl, canvas, camera, level } = this, fine = 0.7 ** Math.max(0, level - 1);
    const ratio = fine * Math.min(MOST_PIXELS, window.devicePixelRatio || 1);
    const [wide, tall] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
    if (canvas.width !== wide || canvas.height !== tall) Object.assign(canvas, { width: wide, height: tall });
    const back = this._back(), matrix = camera.view(wide / tall);
    gl.viewport(0, 0, wide, tall);
    gl.clearColor(back[0], back[1], back[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const light = back[1] > 0.5, toned = (/** @type {number} */ by) => back.map((v) => Math.max(0, v + by));
    if (this.floor !== null) this._floor(matrix, toned(light ? -0.065 : 0.14), back);
    this._points(matrix, camera.pixels(wide, tall), toned(light ? -0.195 : -0.03));
    if (this.solids.length) this._solids(matrix);
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
    const { gl, points, camera, canvas, floor } = this;
    const middle = camera.lower.map((v, c) => 0.5 * (v + camera.upper[c]));
    /** @type {Cut | null} */ const cut = this.cut ? { x: middle, across: [0.47, -0.88] } : null;
    const draw = (/** @type {number} */ radius, /** @type {Float32Array} */ drawn) => {
      gl.uniform1f(points.uniform("pixels"), 2 * pixels * radius);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.drawn);
      gl.bufferData(gl.ARRAY_BUFFER, drawn, gl.STREAM_DRAW);
      this._attribute(points, "point", this.drawn, 4);
      gl.drawArrays(gl.POINTS, 0, drawn.length / 4);
    };
    const visible = this.bodies.filter((own) => own.visible), bodies = visible.filter((own) => cut || !own.surface);
    this._surfaces(visible.filter((own) => !bodies.includes(own)), matrix, dark);
    points.use();
    gl.uniformMatrix4fv(points.uniform("view"), false, matrix);
    gl.uniform3fv(points.uniform("dark"), dark);
    if (floor !== null && this.level === 0) {
      gl.uniform1i(points.uniform("shadow"), 1);
      gl.depthMask(false);
      for (const body of bodies) if (!body.tint) draw(1.2 * body.radius, body.shadow(floor, cut));
      gl.depthMask(true);
    }
    gl.uniform1i(points.uniform("shadow"), 0);
    for (const body of bodies) {
      gl.uniform4fv(points.uniform("tint"), body.tint ? [...body.tint, 1] : [0, 0, 0, 0]);
      draw(body.radius, body.seen(matrix, canvas.width, canvas.height, pixels, cut));
    }
  }

  /** @param {Body[]} bodies that have a surface @param {Float32Array} matrix @param {number[]} dark */
  _surfaces(bodies, matrix, dark) {
    const { gl, surface, camera, floor } = this, { right, up, toward } = camera.axes;
    surface.use();
    gl.uniformMatrix4fv(surface.uniform("view"), false, matrix);
    gl.uniform3fv(surface.uniform("dark"), dark);
    gl.uniform3fv(surface.uniform("sun"), unit([0, 1, 2].map((c) => -0.45 * right[c] + 0.65 * up[c] + 0.62 * toward[c])));
    gl.uniform2fv(surface.uniform("slant"), SLANT);
    gl.uniform1f(surface.uniform("ground"), floor ?? 0);
    for (const body of bodies) {
      const { faces } = /** @type {import("./surface.mjs").Surface} */ (body.surface);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.faces);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STREAM_DRAW);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.drawn);
      gl.bufferData(gl.ARRAY_BUFFER, /** @type {any} */ (body.surface).corners(body), gl.STREAM_DRAW);
      for (const [name, components, at] of /** @type {[string, number, number][]} */ ([["x", 3, 0], ["normal", 3, 12], ["value", 1, 24]]))
        this._attribute(surface, name, this.drawn, components, 28, at);
      for (const shadow of floor !== null && this.level === 0 ? [1, 0] : [0]) {
        gl.uniform1i(surface.uniform("shadow"), shadow);
        gl.depthMask(!shadow);
        gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_SHORT, 0);
      }
    }
  }

  /** @param {Float32Array} matrix */
  _solids(matrix) {
    const { gl, solid: shader, camera } = this;
    shader.use();
    gl.uniformMatrix4fv(shader.uniform("view"), false, matrix);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    for (const solid of this.solids) {
      if (!acts(solid, this.time)) continue;
      const pose = placed(solid, this.time);
      let extents = solid.extents;
      if (solid.shape === "half-space") {
        // A floor is drawn as such; a wall is a thin plate.
        if (solid.extents[2] > 0.99) continue;
        extents = wall(pose, solid.extents, camera.axes.toward, this.scene);
        if (!extents.length) continue;
      }
      const round = solid.shape === "sphere", shape = round ? this.shapes.ball : this.shapes.box;
      if (round) extents = [0, 1, 2].map(() => solid.extents[0]);
      gl.uniformMatrix4fv(shader.uniform("pose"), false, pose);
      gl.uniform3fv(shader.uniform("extents"), extents);
      gl.uniform1i(shader.uniform("ball"), Number(round));
      gl.uniform4f(shader.uniform("tint"), 0.45, 0.52, 0.62, 0.4);
      this._attribute(shader, "x", shape.buffer, 3, 24, 0);
      this._attribute(shader, "normal", shape.buffer, 3, 24, 12);
      gl.drawArrays(gl.TRIANGLES, 0, shape.count);
    }
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
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

  /** Take other colours of the scale. @param {number[]} colors [256 × 3] of 8 bits */
  paint(colors) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.scale);
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
 * Turn a wall's pose so that its third axis is its normal, and put it beside the scene's middle; gives its half edges,
 * along the scene, or none where it stands before the scene.
 * @param {Float32Array} pose [16] by columns, changed in place
 * @param {number[]} normal
 * @param {number[]} toward the viewer
 * @param {{ lower: number[], upper: number[] }} scene corners [m]
 */
function wall(pose, normal, toward, { lower, upper }) {
  if (normal.reduce((sum, v, c) => sum + v * toward[c], 0) < 0.05) return [];
  const middle = lower.map((v, c) => 0.5 * (v + upper[c]));
  const off = normal.reduce((sum, v, c) => sum + v * (middle[c] - pose[12 + c]), 0);
  const flat = Math.abs(normal[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const one = unit(cross(flat, normal)), two = cross(normal, one);
  [one, two, normal].forEach((axis, j) => axis.forEach((v, c) => { pose[4 * j + c] = v; }));
  middle.forEach((v, c) => { pose[12 + c] = v - off * normal[c]; });
  const reach = (/** @type {number[]} */ axis) => 0.55 * axis.reduce((sum, v, c) => sum + Math.abs(v) * (upper[c] - lower[c]), 0);
  return [reach(one), reach(two), 1e-3 * reach(one)];
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

/**
 * Says in which frames to draw, and how finely: what moves is drawn as coarsely as the browser needs to keep up, what
 * stands still is drawn whole.
 */
export class Pace {
  /** @param {{ level: number }} drawing whose level says how coarse it is */
  constructor(drawing) {
    this.drawing = drawing;
    this.level = 0; // of pictures that move
    this.slow = 0;
    this.moving = false;
    this.since = this.last = 0; // [ms]
  }

  /**
   * Whether a picture is drawn in this frame, and how coarse.
   * @param {number} now [ms]
   * @param {boolean} changed whether there is anything new in it
   */
  draws(now, changed) {
    const { drawing } = this, passed = now - this.last;
    this.last = now;
    if (changed) {
      this.slow = this.moving && passed > SLOW ? this.slow + 1 : 0;
      if (this.slow >= OFTEN) {
        this.level = Math.min(this.level + 1, COARSEST);
        this.slow = 0;
      }
      this.moving = true;
      this.since = now;
      drawing.level = this.level;
      return true;
    }
    if (!this.moving || now - this.since < REST) return false;
    this.moving = false;
    const fine = drawing.level === 0;
    drawing.level = 0;
    this.level = Math.max(0, this.level - 1); // what was slow for a while may be fast again
    return !fine;
  }
}
