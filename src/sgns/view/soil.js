// What is seen in space: soil as shaded discs, the tool, the force, the bin. One camera for one or two panels.
//
// Soil of a network is decoded by the graphics card: position = mean + sum of mode * coordinate. Soil of a run comes as
// numbers of 16 bits between the corners of a box.
//
// three.js is three 0.187.0 from npm, with what is imported here: a file that exports these names from "three", and
// OrbitControls from "three/addons/controls/OrbitControls.js", made one by
// npx esbuild names.js --bundle --minify --format=esm --legal-comments=eof --outfile=three.js

import {
  AmbientLight, BoxGeometry, BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry, DataTexture,
  DirectionalLight, DoubleSide, EdgesGeometry, GLSL3, Group, HalfFloatType, LineBasicMaterial, LineSegments, Mesh,
  MeshLambertMaterial, OrbitControls, PerspectiveCamera, Points, RGBAFormat, RawShaderMaterial, Scene, Vector3,
  WebGLRenderer,
} from "./three.js";

const STEEL = "#4d5a66", PAPER = "#faf9f6", WIDTH = 1024; // of the texture of modes
const AZIMUTH = (-60 * Math.PI) / 180, ELEVATION = (26 * Math.PI) / 180;

const HEAD = `
  precision highp float;
  uniform mat4 modelViewMatrix, projectionMatrix;
  uniform float size;  // of a particle, times the picture's height [m px]
  uniform float top;   // end of the colours' scale
  out float share;
  void place(vec3 p, float value) {
    vec4 seen = modelViewMatrix * vec4(p, 1.0);
    gl_Position = projectionMatrix * seen;
    gl_PointSize = max(size * projectionMatrix[1][1] / gl_Position.w, 1.0);
    share = clamp(value / top, 0.0, 1.0);
  }`;

// Written out: a loop over an array of uniforms takes some processors much longer.
const DECODED = (groups) => `${HEAD}
  precision highp sampler2D;
  in vec3 position;
  uniform sampler2D modes;
  uniform vec3 now[${4 * groups}], way[${4 * groups}];
  void main() {
    int at = gl_VertexID * ${groups};
    vec3 p = position, d = vec3(0.0);
    vec4 m;
    ${Array.from({ length: groups }, (_, k) => `
    m = texelFetch(modes, ivec2((at + ${k}) % ${WIDTH}, (at + ${k}) / ${WIDTH}), 0);
    p += ${sum("now", k)};
    d += ${sum("way", k)};`).join("")}
    place(p, length(d));
  }`;
const sum = (name, k) => ["x", "y", "z", "w"].map((c, i) => `m.${c} * ${name}[${4 * k + i}]`).join(" + ");

const RECORDED = `${HEAD}
  in vec4 position, first, other;  // shares of boxes, and of the largest speed
  uniform vec3 low, high, lowFirst, highFirst, lowOther, highOther;
  uniform float fastest;
  uniform int colour;
  void main() {
    vec3 p = mix(low, high, position.xyz);
    vec3 from = colour == 1 ? mix(lowFirst, highFirst, first.xyz) : mix(lowOther, highOther, other.xyz);
    place(p, colour == 0 ? fastest * position.w : distance(p, from));
  }`;

const SHADED = `
  precision highp float;
  uniform vec3 stops[9];
  in float share;
  out vec4 colour;
  void main() {
    vec2 at = 2.0 * gl_PointCoord - 1.0;
    float square = dot(at, at);
    if (square > 1.0) discard;
    float place = 8.0 * share;
    int stop = min(int(place), 7);
    vec3 paint = mix(stops[stop], stops[stop + 1], place - float(stop));
    float light = max(dot(vec3(at.x, -at.y, sqrt(1.0 - square)), vec3(-0.35, 0.55, 0.76)), 0.0);
    colour = vec4((0.62 + 0.38 * light) * paint, 1.0);
  }`;

// A number of half precision.
function half(bits) {
  const power = (bits >> 10) & 31, part = bits & 1023;
  return (bits >> 15 ? -1 : 1) * (power ? 2 ** (power - 15) * (1 + part / 1024) : 2 ** -24 * part);
}

const material = (vertexShader, uniforms) => new RawShaderMaterial({
  glslVersion: GLSL3, vertexShader, fragmentShader: SHADED,
  uniforms: { size: { value: 1 }, top: { value: 1 }, stops: { value: [] }, ...uniforms },
});

const steel = () => new MeshLambertMaterial({ color: STEEL, side: DoubleSide, flatShading: true });

class Panel {
  constructor(about) {
    this.scene = new Scene();
    this.scene.background = new Color(PAPER);
    const sun = new DirectionalLight("#ffffff", 2.2);
    sun.position.set(-1, -2.5, 3);
    this.scene.add(new AmbientLight("#ffffff", 1.3), sun);
    const [x, y, z] = about.bed;
    const bin = new LineSegments(new EdgesGeometry(new BoxGeometry(x, y, z)), new LineBasicMaterial({ color: "#b9b4a8" }));
    bin.position.set(x / 2, y / 2, -z / 2);
    this.scene.add(bin);
    this.about = about;
    this.bodies = [];
    this.foot = new Vector3(); // where the force pushes, in the first body's frame
    this.arrow = new Group();
    // Seen through the soil that the tool is in.
    const paint = new MeshLambertMaterial({ color: "#0072b2", emissive: "#00344f", depthTest: false, transparent: true });
    this.shaft = new Mesh(new CylinderGeometry(0.012, 0.012, 1, 20).translate(0, 0.5, 0), paint);
    this.head = new Mesh(new ConeGeometry(0.034, 0.09, 24).translate(0, 0.045, 0), paint);
    this.arrow.add(this.shaft, this.head);
    this.shaft.renderOrder = this.head.renderOrder = 1;
    this.scene.add(this.arrow);
  }

  soil(geometry, shader, uniforms) {
    this.material = material(shader, uniforms);
    this.points = new Points(geometry, this.material);
    this.points.frustumCulled = false;
    this.scene.add(this.points);
  }

  body(corners) {
    const shape = new BufferGeometry().setAttribute("position", new BufferAttribute(corners, 3));
    shape.computeVertexNormals();
    const body = new Group();
    if (corners.length) {
      body.add(new Mesh(shape, steel()));
      body.add(new LineSegments(new EdgesGeometry(shape, 25), new LineBasicMaterial({ color: "#1a1a1a" })));
    }
    if (!this.bodies.length && !this.about.wheel) { // the force is drawn at the lowest corners; of a wheel at the axle
      const low = corners.reduce((z, v, i) => (i % 3 === 2 ? Math.min(z, v) : z), Infinity), wide = 1e-3 * this.about.bed[0];
      let count = 0;
      for (let i = 0; i < corners.length; i += 3) if (corners[i + 2] < low + wide) {
        this.foot.add(new Vector3(corners[i], corners[i + 1], corners[i + 2]));
        count += 1;
      }
      this.foot.divideScalar(Math.max(count, 1));
    }
    this.bodies.push(body);
    this.scene.add(body);
  }

  // Where body `i` is: x, y, z [m] and a quaternion.
  move(i, pose, at = 0) {
    this.bodies[i].position.set(pose[at], pose[at + 1], pose[at + 2]);
    this.bodies[i].quaternion.set(pose[at + 3], pose[at + 4], pose[at + 5], pose[at + 6]);
  }

  // The force that pushes the first body.
  push(force) {
    const way = new Vector3(...force), size = way.length(), scale = this.about.arrow, longest = 0.5 * this.about.bed[0];
    this.arrow.visible = size * scale > 0.02 * longest && Number.isFinite(size);
    if (!this.arrow.visible) return;
    const long = Math.min(size * scale, longest), head = Math.min(0.09 * longest, 0.5 * long), body = this.bodies[0];
    way.normalize();
    this.arrow.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), way);
    this.arrow.position.copy(this.foot).applyQuaternion(body.quaternion).add(body.position).addScaledVector(way, -long);
    const thick = head / 0.09; // a short arrow is thin
    this.shaft.scale.set(thick, long - 0.9 * head, thick);
    this.head.position.set(0, long - head, 0);
    this.head.scale.set(thick, thick, thick);
  }
}

export class View {
  constructor(canvas, about) {
    this.about = about;
    this.canvas = canvas;
    // A processor that stands in for a graphics card has no time for smooth edges.
    const probe = document.createElement("canvas").getContext("webgl2");
    const drawer = probe?.getExtension("WEBGL_debug_renderer_info");
    const slow = /swiftshader|llvmpipe|software/i.test(drawer ? probe.getParameter(drawer.UNMASKED_RENDERER_WEBGL) : "");
    probe?.getExtension("WEBGL_lose_context")?.loseContext();
    this.renderer = new WebGLRenderer({ canvas, antialias: !slow, powerPreference: "high-performance" });
    this.renderer.setScissorTest(true);
    this.camera = new PerspectiveCamera(32, 1, 0.01, 100);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enablePan = true;
    this.controls.maxPolarAngle = 0.52 * Math.PI;
    this.controls.addEventListener("change", () => (this.stale = true));
    this.controls.addEventListener("end", () => this.order());
    this.panels = [];
    this.finest = this.detail = Math.min(window.devicePixelRatio || 1, 2); // the picture's points per point of the page
    this.colours = null;
    this.shown = "speed";
    this.dug = about.mode === "drive" ? 0 : Infinity; // how deep a tool has been [m]
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  // --- what there is ---------------------------------------------------------------------------------------

  decoded(mean, modes, rest, corners) {
    const count = mean.length / 3, wide = this.about.modes, groups = Math.ceil(wide / 4);
    const texels = new Uint16Array(4 * WIDTH * Math.ceil((count * groups) / WIDTH));
    for (let i = 0; i < count; i++)
      for (let k = 0; k < wide; k++) texels[4 * groups * i + k] = modes[wide * i + k];
    const texture = new DataTexture(texels, WIDTH, texels.length / 4 / WIDTH, RGBAFormat, HalfFloatType);
    texture.needsUpdate = true;
    const zeros = () => new Float32Array(12 * groups);
    this.rest = zeros();
    this.rest.set(rest);
    this.now = this.rest.slice();
    this.last = this.rest.slice();
    const panel = new Panel(this.about);
    panel.soil(new BufferGeometry().setAttribute("position", new BufferAttribute(mean, 3)), DECODED(groups), {
      modes: { value: texture }, now: { value: this.now }, way: { value: zeros() },
    });
    panel.body(corners);
    panel.places = mean.slice(); // at rest
    for (let i = 0; i < count; i++)
      for (let k = 0; k < wide; k++) {
        const weight = half(modes[wide * i + k]);
        for (let axis = 0; axis < 3; axis++) panel.places[3 * i + axis] += weight * rest[3 * k + axis];
      }
    this.panels.push(panel);
  }

  recorded(count, bodies) {
    const panel = new Panel(this.about), shape = new BufferGeometry();
    for (const name of ["position", "first", "other"])
      shape.setAttribute(name, new BufferAttribute(new Uint16Array(4 * count), 4, true));
    const box = () => ({ value: new Vector3() });
    panel.soil(shape, RECORDED, {
      low: box(), high: box(), lowFirst: box(), highFirst: box(), lowOther: box(), highOther: box(),
      fastest: { value: 0 }, colour: { value: 0 },
    });
    for (const corners of bodies) panel.body(corners);
    this.panels.push(panel);
  }

  // --- a frame ---------------------------------------------------------------------------------------------

  coordinates(modes) {
    [this.last, this.now] = [this.now, this.last];
    this.now.set(modes);
    this.measure();
  }

  // What the soil is coloured by: its velocity, or its way from where it was at rest.
  measure() {
    const { now, way } = this.panels[0].material.uniforms, speed = this.shown === "speed";
    const from = speed ? this.last : this.rest, gain = speed ? this.about.rate : 1;
    now.value = this.now;
    way.value.forEach((_, k) => (way.value[k] = gain * (this.now[k] - from[k])));
  }

  still() { // after a jump: nothing has moved since the frame before
    this.last.set(this.now);
    this.measure();
  }

  positions(i, shares, low, high, fastest, first) {
    const panel = this.panels[i], of = panel.material.uniforms;
    const fill = (to, name) => {
      const attribute = to.points.geometry.attributes[name];
      attribute.array.set(shares);
      attribute.needsUpdate = true;
    };
    fill(panel, "position");
    of.low.value.set(...low);
    of.high.value.set(...high);
    of.fastest.value = fastest;
    if (first) {
      fill(panel, "first");
      panel.places = Float32Array.from({ length: (3 * shares.length) / 4 }, (_, k) => {
        const axis = k % 3;
        return low[axis] + ((high[axis] - low[axis]) * shares[(4 * (k - axis)) / 3 + axis]) / 65535;
      });
      of.lowFirst.value.set(...low);
      of.highFirst.value.set(...high);
    }
    const other = this.panels[1 - i];
    if (other) {
      fill(other, "other");
      other.material.uniforms.lowOther.value.set(...low);
      other.material.uniforms.highOther.value.set(...high);
    }
  }

  colour(name, stops, top) {
    this.shown = name;
    this.stale = true;
    for (const panel of this.panels) {
      const of = panel.material.uniforms;
      of.stops.value = stops.map((one) => {
        const paint = parseInt(one.slice(1), 16); // as written: neither the light nor the screen changes it
        return new Vector3((paint >> 16) / 255, ((paint >> 8) & 255) / 255, (paint & 255) / 255);
      });
      of.top.value = top;
      if (of.way) this.measure();
      else of.colour.value = ["speed", "displacement", "error"].indexOf(name);
    }
  }

  // --- the picture -----------------------------------------------------------------------------------------

  get across() { // panels side by side; below each other where the picture is narrow
    return this.panels.length > 1 && this.width > this.height;
  }

  resize() {
    this.stale = true;
    const box = this.canvas.parentElement.getBoundingClientRect();
    this.width = Math.max(box.width, 1);
    this.height = Math.max(box.height, 1);
    this.renderer.setSize(this.width, this.height, false);
    this.look();
  }

  // The camera where the bed fills the picture; a person may turn it.
  look() {
    const [x, y, z] = this.about.bed, many = this.panels.length || 1;
    const wide = this.across ? this.width / many : this.width, high = this.across ? this.height : this.height / many;
    const up = 0.94 * Math.tan((this.camera.fov * Math.PI) / 360), side = up * (wide / high);
    this.controls.target.set(0.5 * x, 0.5 * y, 0.5 * (0.2 * x - z));
    const [c, s, C, S] = [Math.cos(AZIMUTH), Math.sin(AZIMUTH), Math.cos(ELEVATION), Math.sin(ELEVATION)];
    const toward = new Vector3(C * c, C * s, S), right = new Vector3(-s, c, 0), above = toward.clone().cross(right);
    let away = 0; // so far that all corners of bed and tool are seen
    for (const corner of [0, 1, 2, 3, 4, 5, 6, 7]) {
      const [i, j, k] = [corner & 1, (corner >> 1) & 1, corner >> 2];
      const at = new Vector3(i * x, j * y, k ? 0.3 * x : -z).sub(this.controls.target);
      away = Math.max(away, at.dot(toward) + Math.max(Math.abs(at.dot(right)) / side, Math.abs(at.dot(above)) / up));
    }
    this.camera.position.copy(toward).multiplyScalar(away).add(this.controls.target);
    this.controls.update();
  }

  // What stands still is drawn as fine as the screen is.
  draw(still = false) {
    const detail = still ? this.finest : this.detail;
    [this.stale, this.fine] = [false, still];
    if (this.renderer.getPixelRatio() !== detail) this.renderer.setPixelRatio(detail);
    const many = this.panels.length, across = this.across;
    const wide = across ? this.width / many : this.width, high = across ? this.height : this.height / many;
    this.camera.aspect = wide / high;
    this.camera.updateProjectionMatrix();
    this.panels.forEach((panel, i) => {
      const left = across ? i * wide : 0, bottom = across ? 0 : (many - 1 - i) * high;
      this.renderer.setViewport(left, bottom, wide, high);
      this.renderer.setScissor(left, bottom, wide, high);
      panel.material.uniforms.size.value = 1.2 * this.about.spacing * 0.5 * high * detail;
      this.renderer.render(panel.scene, this.camera);
    });
  }

  // Particles that are nearer are drawn first and hide the rest, which then costs less. Those far below all that was
  // dug, and not at a side of the bin, nobody can see.
  order() {
    const { x, y, z } = this.camera.position, [X, Y, Z] = this.about.bed, few = 1.5 * this.about.spacing;
    const low = -this.dug - 4 * this.about.spacing;
    for (const panel of this.panels) {
      const p = panel.places, away = new Float32Array(p.length / 3);
      for (let i = 0; i < away.length; i++) away[i] = Math.hypot(p[3 * i] - x, p[3 * i + 1] - y, p[3 * i + 2] - z);
      const hidden = (i) => {
        const [u, v, w] = [p[3 * i], p[3 * i + 1], p[3 * i + 2]];
        return w < low && w > few - Z && u > few && u < X - few && v > few && v < Y - few;
      };
      const seen = Uint32Array.from(away, (_, i) => i).filter((i) => !hidden(i)).sort((i, j) => away[i] - away[j]);
      panel.points.geometry.setIndex(new BufferAttribute(seen, 1));
    }
    this.stale = true;
  }

  // The tool is this deep [m].
  dig(depth) {
    if (depth < this.dug + this.about.spacing) return;
    this.dug = depth;
    this.order();
  }

  // Fewer points of the screen where the machine is slow.
  coarser() {
    this.detail = Math.min(this.detail, Math.max(0.5, 0.75 * this.detail));
  }
}
