// A renderer for one shape, the capsule: links, points, tubes and lines are capsules. WebGL 2, instanced.

const VERTEX = `#version 300 es
layout(location = 0) in vec4 shape;      // unit normal, and which end
layout(location = 1) in vec4 fromRadius;
layout(location = 2) in vec4 toFlat;
layout(location = 3) in vec4 tint;
uniform mat4 camera;
uniform vec3 eye;
out vec3 normal;
out vec3 seen;
out vec4 colour;
out float fog;
void main() {
  vec3 way = toFlat.xyz - fromRadius.xyz;
  float length_ = length(way);
  vec3 z = length_ > 1e-6 ? way / length_ : vec3(0.0, 0.0, 1.0);
  vec3 x = normalize(abs(z.z) < 0.9 ? cross(z, vec3(0.0, 0.0, 1.0)) : cross(z, vec3(1.0, 0.0, 0.0)));
  normal = mat3(x, cross(z, x), z) * shape.xyz;
  vec3 place = mix(fromRadius.xyz, toFlat.xyz, shape.w) + fromRadius.w * normal;
  if (toFlat.w > 0.5) {
    // A shadow: light from above, slightly from behind.
    place = vec3(place.xy + 0.25 * place.z * vec2(-0.6, 0.5), 0.0008);
    normal = vec3(0.0, 0.0, 1.0);
  }
  seen = eye - place;
  colour = tint;
  fog = toFlat.w < 0.0 ? smoothstep(0.5, 1.5, length(place.xy - vec2(0.2, 0.0))) : 0.0;
  gl_Position = camera * vec4(place, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 normal;
in vec3 seen;
in vec4 colour;
in float fog;
uniform float lit;
out vec4 pixel;
void main() {
  vec3 n = normalize(normal);
  vec3 light = normalize(vec3(0.5, -0.4, 0.9));
  float sky = 0.62 + 0.38 * n.z;
  float sun = max(dot(n, light), 0.0);
  float edge = pow(1.0 - max(dot(n, normalize(seen)), 0.0), 3.0);
  float shine = pow(max(dot(reflect(-light, n), normalize(seen)), 0.0), 24.0);
  vec3 shaded = colour.rgb * (0.42 * sky + 0.62 * sun) + 0.16 * shine + 0.06 * edge;
  pixel = vec4(mix(colour.rgb, shaded, lit), colour.a * (1.0 - fog));
}`;

const SEGMENTS = 14;
const RINGS = 4;
const FLOATS = 12;

/** How an instance is drawn. */
export const LINE = -1;
export const SOLID = 0;
export const SHADOW = 1;

export class Renderer {
  /** Throws where there is no WebGL 2. */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: false });
    if (!gl) throw new Error("no WebGL 2");
    this.gl = gl;
    this.program = compile(gl);
    this.camera = gl.getUniformLocation(this.program, "camera");
    this.eye = gl.getUniformLocation(this.program, "eye");
    this.lit = gl.getUniformLocation(this.program, "lit");
    const [points, order] = capsule();
    this.count = order.length;
    this.vao = gl.createVertexArray();
    gl.bindVertexArray(this.vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, points, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 4, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, order, gl.STATIC_DRAW);
    this.instances = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    for (let i = 0; i < 3; i++) {
      gl.enableVertexAttribArray(1 + i);
      gl.vertexAttribPointer(1 + i, 4, gl.FLOAT, false, FLOATS * 4, i * 16);
      gl.vertexAttribDivisor(1 + i, 1);
    }
    this.floats = new Float32Array(FLOATS * 512);
    this.layers = { floor: [], solid: [], clear: [] };
  }

  /** A capsule from `a` to `b`, radius `r`, colour [r, g, b, a] in `layer` of this frame. */
  add(layer, a, b, r, colour, kind = SOLID) {
    this.layers[layer].push([a, b, r, colour, kind]);
  }

  draw(view, ground) {
    const gl = this.gl;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(...ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    gl.bindVertexArray(this.vao);
    gl.uniformMatrix4fv(this.camera, false, view.matrix);
    gl.uniform3fv(this.eye, view.eye);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    this.layer("floor", 0);
    this.layer("solid", 1);
    // What is clear hides nothing, and does not hide itself twice.
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    this.layer("clear", 0.4);
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
  }

  layer(name, lit) {
    const all = this.layers[name];
    const gl = this.gl;
    if (all.length * FLOATS > this.floats.length) this.floats = new Float32Array(all.length * FLOATS * 2);
    all.forEach(([a, b, r, colour, kind], i) => this.floats.set([...a, r, ...b, kind, ...colour], i * FLOATS));
    gl.uniform1f(this.lit, lit);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    gl.bufferData(gl.ARRAY_BUFFER, this.floats.subarray(0, all.length * FLOATS), gl.DYNAMIC_DRAW);
    gl.drawElementsInstanced(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0, all.length);
    this.layers[name] = [];
  }
}

function compile(gl) {
  const program = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error(gl.getProgramInfoLog(program) || "the shaders do not link");
  }
  return program;
}

/** A sphere cut at its equator: the upper half belongs to the far end. */
function capsule() {
  const points = [];
  const order = [];
  for (let ring = 0; ring < 2 * RINGS + 2; ring++) {
    const end = ring > RINGS ? 1 : 0;
    const latitude = ((ring - end - RINGS) / RINGS) * (Math.PI / 2);
    for (let i = 0; i <= SEGMENTS; i++) {
      const longitude = (i / SEGMENTS) * 2 * Math.PI;
      const [c, s] = [Math.cos(latitude), Math.sin(latitude)];
      points.push(c * Math.cos(longitude), c * Math.sin(longitude), s, end);
    }
  }
  const row = SEGMENTS + 1;
  for (let ring = 0; ring < 2 * RINGS + 1; ring++) {
    for (let i = 0; i < SEGMENTS; i++) {
      const a = ring * row + i;
      order.push(a, a + 1, a + row, a + 1, a + row + 1, a + row);
    }
  }
  return [new Float32Array(points), new Uint16Array(order)];
}
