// WebGL2 painter: one instanced quad per Gaussian, blended from back to front.

import * as api from "./api.js";
import { fragment, vertex } from "./shaders.js";

const WIDTH = 4096;

async function unzipped(buffer) {
  return new Response(new Blob([buffer]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

// Read SPZ version 2 as texels: one has position, opacity and log scales; `texels` more have colour, rotation and harmonics, a byte each.
async function readChunk(buffer) {
  const bytes = new Uint8Array(await unzipped(buffer)), head = new DataView(bytes.buffer);
  const count = head.getUint32(8, true), degree = bytes[12], unit = 2 ** -bytes[13], others = 3 * ((degree + 1) ** 2 - 1);
  const texels = Math.ceil((6 + others) / 16), geometry = new ArrayBuffer(16 * count), places = new Float32Array(geometry), rest = new Uint8Array(16 * texels * count);
  let at = 16;
  for (let i = 0; i < count; i++) for (let axis = 0; axis < 3; axis++, at += 3)
    places[4 * i + axis] = unit * (bytes[at] + 256 * bytes[at + 1] + 65536 * (bytes[at + 2] << 24 >> 24));
  const column = (target, stride, first, width) => {
    for (let i = 0; i < count; i++) for (let k = 0; k < width; k++) target[stride * i + first + k] = bytes[at++];
  };
  const small = new Uint8Array(geometry);
  column(small, 16, 12, 1);             // opacity
  column(rest, 16 * texels, 0, 3);      // colour
  column(small, 16, 13, 3);             // scales
  column(rest, 16 * texels, 3, 3);      // rotation
  column(rest, 16 * texels, 6, others); // harmonics
  return { count, bases: (degree + 1) ** 2, texels, geometry: new Uint32Array(geometry), rest: new Uint32Array(rest.buffer), places };
}

export function describe() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return { works: false, name: "no WebGL2" };
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return { works: true, name, software: /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name) };
}

export class Renderer {
  kind = "gl";

  constructor(host, onOrdered, onLost) {
    this.canvas = document.createElement("canvas");
    host.prepend(this.canvas);
    this.canvas.addEventListener("webglcontextlost", onLost);
    this.gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    this.onOrdered = onOrdered;
    this.nodeTextures = new Map();
    this.sorted = { count: 0, row: null, pending: false };
    this.worker = api.sorter();
    this.worker.onmessage = ({ data }) => this.ordered(data);
  }

  // Gaussians arrive in chunks of whole texel rows; each chunk is drawn as soon as it arrives.
  async load({ gaussians, chunk }, chunkOf, told) {
    const gl = this.gl, first = await readChunk(await chunkOf(0)), { bases, texels } = first;
    if (Math.ceil(gaussians * texels / WIDTH) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(`${gaussians} Gaussians exceed this browser's maximum texture size`);
    this.count = gaussians;
    this.here = 0;
    this.program = this.link(vertex(bases, texels));
    this.geometry = this.texture(gl.RGBA32UI, gaussians);
    this.rest = this.texture(gl.RGBA32UI, texels * gaussians);
    this.nodeTextures.set("", this.texture(gl.RGBA16UI, gaussians));
    this.marks = this.texture(gl.R8UI, gaussians);
    this.style = gl.createTexture(); this.ramp = gl.createTexture();
    this.target = gl.createFramebuffer(); this.targetTexture = gl.createTexture();
    this.arrays();
    this.worker.postMessage({ count: gaussians });
    this.arrived(first);
    this.loaded = this.loadRest(Math.ceil(gaussians / chunk), chunkOf, told);
  }

  async loadRest(chunks, chunkOf, told) {
    for (let number = 1; number < chunks; number++) {
      told(number, chunks);
      this.arrived(await readChunk(await chunkOf(number)));
      this.onOrdered();
    }
    told(chunks, chunks);
  }

  arrived({ count, texels, geometry, rest, places }) {
    this.fill(this.geometry, geometry, this.here);
    this.fill(this.rest, rest, texels * this.here);
    const means = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) for (let axis = 0; axis < 3; axis++) means[3 * i + axis] = places[4 * i + axis];
    this.worker.postMessage({ means, first: this.here }, [means.buffer]);
    this.here += count;
    this.sorted.row = null;
  }

  // Node numbers have 16 bits or, in a large tree, 32.
  async loadNodes(variant) {
    const bytes = await unzipped(await api.nodes(variant));
    this.putNodes(variant, bytes.byteLength > 8 * this.count ? new Uint32Array(bytes) : new Uint16Array(bytes));
  }

  putNodes(variant, values) {
    const texture = this.texture(values instanceof Uint32Array ? this.gl.RGBA32UI : this.gl.RGBA16UI, this.count);
    this.fill(texture, values, 0);
    this.nodeTextures.set(variant, texture);
    (this.nodeValues ??= new Map()).set(variant, values);
  }

  // Store each Gaussian's field relevancy in the spare channel.
  loadField(variant, bytes) {
    const values = this.nodeValues.get(variant);
    for (let i = 0; i < bytes.length; i++) values[4 * i + 3] = bytes[i];
    this.gl.deleteTexture(this.nodeTextures.get(variant));
    this.putNodes(variant, values);
  }

  // Show marks: 1 for selected Gaussians, 2 for removed ones.
  mark(marks) {
    const gl = this.gl, rows = Math.ceil(marks.length / WIDTH), full = new Uint8Array(WIDTH * rows);
    full.set(marks);
    gl.bindTexture(gl.TEXTURE_2D, this.marks);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_BYTE, full);
  }

  link(vertexText) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertexText], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.bindAttribLocation(program, 0, "corner");
    gl.bindAttribLocation(program, 1, "index");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    this.places = new Proxy({}, { get: (kept, name) => kept[name] ??= gl.getUniformLocation(program, name) });
    return program;
  }

  texture(internal, texels) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, WIDTH, Math.max(1, Math.ceil(texels / WIDTH)));
    this.nearest();
    return texture;
  }

  // Write texels, of 16 or 32 bits, from `first`, which starts a row; the last row may be incomplete.
  fill(texture, data, first) {
    const gl = this.gl, texels = data.length / 4, full = Math.floor(texels / WIDTH), rest = texels - full * WIDTH, row = first / WIDTH;
    const type = data instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, WIDTH, full, gl.RGBA_INTEGER, type, data, 0);
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row + full, rest, 1, gl.RGBA_INTEGER, type, data, full * WIDTH * 4);
  }

  nearest() {
    const gl = this.gl;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }

  arrays() {
    const gl = this.gl;
    gl.bindVertexArray(gl.createVertexArray());
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.orderBuffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * this.count, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
  }

  // Request the order for this camera; `ordered` redraws when it arrives.
  order(camera) {
    const [x, y, z] = camera.R[2], row = [x, -y, -z, camera.translation[2]], s = this.sorted;   // in the axes of SPZ
    s.wanted = row;
    if (s.pending || (s.row && row.every((v, k) => v === s.row[k]))) return;
    s.pending = true; s.row = row;
    this.worker.postMessage({ row, order: s.spare }, s.spare ? [s.spare.buffer] : []);
    s.spare = undefined;
  }

  ordered({ order, count }) {
    const gl = this.gl, s = this.sorted;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order, 0, count);
    Object.assign(s, { count, spare: order, pending: false });
    this.onOrdered();
  }

  get settled() { return !this.sorted.pending && this.sorted.row && this.sorted.wanted.every((v, k) => v === this.sorted.row[k]); }

  // panes: [{variant, style}], side by side with one camera. width and height: of the whole canvas, px.
  draw(camera, panes, width, height) {
    const gl = this.gl;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.order(camera);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const each = Math.floor(width / panes.length);
    panes.forEach((pane, k) => this.pane(camera, pane, k * each, each, height, 0));
    this.numbers = null;
  }

  pane(camera, pane, left, width, height, numbering) {
    const gl = this.gl, at = this.places, k = camera.intrinsics(width, height);
    gl.viewport(left, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, 0, width, height);
    gl.useProgram(this.program);
    this.uploadStyle(pane.style);
    const textures = [["geometry", this.geometry], ["rest", this.rest],
      ["nodes", this.nodeTextures.get(pane.variant) ?? this.nodeTextures.get("")], ["style", this.style], ["ramp", this.ramp], ["marks", this.marks]];
    textures.forEach(([name, texture], number) => {
      gl.activeTexture(gl.TEXTURE0 + number);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(at[name], number);
    });
    const R = camera.R, margin = [0.15 * width / k.fx, 0.15 * height / k.fy];
    gl.uniformMatrix3fv(at.rotation, true, R.flatMap(([x, y, z]) => [x, -y, -z]));   // from the axes of SPZ
    gl.uniform3fv(at.translation, camera.translation);
    gl.uniform3f(at.centre, camera.c[0], -camera.c[1], -camera.c[2]);
    gl.uniform4f(at.lens, k.fx, k.fy, k.cx, k.cy);
    gl.uniform4f(at.limits, -k.cx / k.fx - margin[0], (width - k.cx) / k.fx + margin[0], -k.cy / k.fy - margin[1], (height - k.cy) / k.fy + margin[1]);
    gl.uniform2f(at.size, width, height);
    gl.uniform3iv(at.use, pane.style.use.map(Number));
    gl.uniform1i(at.mode, ["plain", "tint", "ghost", "isolate"].indexOf(pane.style.mode));
    gl.uniform1i(at.ramped, Number(Boolean(pane.style.ramp)));
    gl.uniform1i(at.numbering, numbering);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.sorted.count);
  }

  uploadStyle(style) {
    if (this.styleBytes === style.table && this.rampBytes === style.ramp) return;
    this.styleBytes = style.table; this.rampBytes = style.ramp;
    const rows = Math.max(1, Math.ceil(style.table.length / 4 / WIDTH)), full = new Uint8Array(4 * WIDTH * rows), ramp = new Uint8Array(4 * 256);
    full.set(style.table);
    if (style.ramp) for (let i = 0; i < 256; i++) ramp.set(style.ramp.subarray(3 * i, 3 * i + 3), 4 * i);
    this.gl.activeTexture(this.gl.TEXTURE0);
    this.colours(this.style, WIDTH, rows, full);
    this.colours(this.ramp, 256, 1, ramp);
  }

  // Make a texture of RGBA bytes, empty without `bytes`.
  colours(texture, width, height, bytes = null) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    this.nearest();
  }

  // Return the Gaussian shown at a pixel of a pane, or -1; Gaussian numbers are drawn once per camera.
  gaussianAt(camera, pane, x, y, width, height) {
    const gl = this.gl, w = Math.max(1, Math.round(width / 2)), h = Math.max(1, Math.round(height / 2));
    if (!this.numbers || this.numbers.w !== w || this.numbers.h !== h) {
      gl.activeTexture(gl.TEXTURE7);
      this.colours(this.targetTexture, w, h);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.targetTexture, 0);
      gl.disable(gl.BLEND); gl.disable(gl.SCISSOR_TEST);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      this.pane(camera, { ...pane, style: { ...pane.style, mode: pane.style.mode === "isolate" ? "isolate" : "plain" } }, 0, w, h, 1);
      this.numbers = { w, h };
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    const pixel = new Uint8Array(4);
    gl.readPixels(Math.floor(x / 2), h - 1 - Math.floor(y / 2), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return pixel[3] ? pixel[0] + 256 * pixel[1] + 65536 * pixel[2] - 1 : -1;
  }

  nodesAt(variant, gaussian) {
    const values = this.nodeValues?.get(variant);
    return values && gaussian >= 0 ? [0, 1, 2].map((level) => values[4 * gaussian + level] - 1) : [-1, -1, -1];
  }

  // A picture must be drawn and read in one task, because the canvas is not preserved.
  capture(camera, panes, width, height) {
    this.draw(camera, panes, width, height);
    return new Promise((done) => this.canvas.toBlob(done, "image/png"));
  }

  pixels(camera, panes, width, height) {
    this.draw(camera, panes, width, height);
    const data = new Uint8Array(4 * width * height);
    this.gl.readPixels(0, 0, width, height, this.gl.RGBA, this.gl.UNSIGNED_BYTE, data);
    return data;
  }
}
