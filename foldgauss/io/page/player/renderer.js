// WebGL2: renders the Gaussians of one time into a texture of floats, and shows it on the screen.
import { TEXTURE_WIDTH } from "./gaussians.js";
import { mapsAt } from "./paths.js";
import splatVertex from "./splat.vert.glsl";
import splatFragment from "./splat.frag.glsl";
import showVertex from "./show.vert.glsl";
import showFragment from "./show.frag.glsl";
import mixFragment from "./mix.frag.glsl";

export const WHAT = { model: 0, original: 1, difference: 2 };
/** Color of selected Gaussians, and the bit of an instance that marks them. */
const TINT = [1, 0.58, 0.2];
export const SELECTED = 2 ** 31;
const NO_BOUND = 1e30;
const ALL_OF_IT = [0, 0, 1, 1], UPRIGHT = [0, 1, 1, -1]; // a whole target, whose rows go up
/** Models on the graphics card at once: those of a fade, and the next one. */
const HELD = 4;

function compile(gl, kind, source) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  return shader;
}

/** A program and the locations of its uniforms by name. */
function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  gl.attachShader(made, compile(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(made, compile(gl, gl.FRAGMENT_SHADER, fragment));
  gl.bindAttribLocation(made, 0, "instance");
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(made, k);
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

function texture(gl, filter) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, filter);
  return made;
}

/** A texture to render into, of a size and a format set on demand. */
class Target {
  constructor(gl) {
    this.gl = gl;
    this.texture = texture(gl, gl.LINEAR);
    this.buffer = gl.createFramebuffer();
    this.width = this.height = 0;
  }

  bind(width, height, format) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.viewport(0, 0, width, height);
    if (width === this.width && height === this.height && format === this.format) return;
    Object.assign(this, { width, height, format });
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    const kind = { [gl.RGBA32F]: gl.FLOAT, [gl.RGBA16F]: gl.HALF_FLOAT, [gl.RGBA8]: gl.UNSIGNED_BYTE }[format];
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, kind, null);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
  }
}

export class Renderer {
  /** Throws an Error for display if the browser lacks WebGL 2. */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL 2, or it is switched off.");
    this.gl = gl;
    this.restore();
  }

  /** Create all resources on the graphics card, also after its context was lost. */
  restore() {
    const { gl } = this;
    const floats = gl.getExtension("EXT_color_buffer_float"), half = floats || gl.getExtension("EXT_color_buffer_half_float");
    const single = floats && gl.getExtension("EXT_float_blend") && gl.getExtension("OES_texture_float_linear");
    this.fast = half ? gl.RGBA16F : gl.RGBA8; // while it plays: half floats are off by up to two levels of 255
    this.exact = single ? gl.RGBA32F : this.fast;
    this.splat = program(gl, splatVertex, splatFragment);
    this.show = program(gl, showVertex, showFragment);
    this.blend = program(gl, showVertex, mixFragment);
    this.rendered = new Target(gl);
    this.mixed = new Target(gl);
    this.result = this.rendered; // the target that is shown
    this.bytes = new Target(gl);
    this.original = texture(gl, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    this.originalShown = null;
    this.maps = texture(gl, gl.NEAREST);
    this.instances = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.disable(gl.DITHER);
    this.held = new Map(); // textures by the values in them, least recently used first
  }

  /** Throw an Error for display if a model is too large. */
  check(model) {
    const { gl } = this;
    if (model.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE) && !gl.isContextLost())
      throw new Error(`This graphics card cannot hold ${model.num.toLocaleString("en")} Gaussians.`);
  }

  /** The texture of a model's Gaussians, uploaded if necessary. Those of the same values are the same. */
  take({ values, rows }) {
    const { gl, held } = this, found = held.get(values);
    held.delete(values);
    if (!found)
      for (const [old, own] of held) {
        if (held.size < HELD) break;
        held.delete(old);
        gl.deleteTexture(own);
      }
    const made = found ?? texture(gl, gl.NEAREST), size = [TEXTURE_WIDTH, rows];
    if (!found) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, ...size, 0, gl.RGBA, gl.FLOAT, values);
    held.set(values, made);
    return made;
  }

  /** Upload the texels again of a part that was placed in a model; see `place`. */
  update({ values, texels }, part) {
    const { gl } = this, first = Math.floor((part.first * texels) / TEXTURE_WIDTH);
    const rows = Math.ceil((part.first * texels + part.values.length / 4) / TEXTURE_WIDTH) - first;
    if (!this.held.has(values)) return;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.held.get(values));
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, TEXTURE_WIDTH, rows, gl.RGBA, gl.FLOAT, values.subarray(4 * TEXTURE_WIDTH * first));
  }

  /** Upload the maps of shared paths at a time, two texels each. */
  takeMaps({ paths }, time) {
    const { gl } = this, count = paths?.count ?? 0, rows = Math.max(Math.ceil((2 * count) / TEXTURE_WIDTH), 1);
    const width = rows > 1 ? TEXTURE_WIDTH : Math.max(2 * count, 1), texels = new Float32Array(4 * width * rows);
    if (paths) mapsAt(paths, time).subarray(6).forEach((own, k) => (texels[4 * Math.floor(k / 3) + (k % 3)] = own));
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.maps);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, rows, 0, gl.RGBA, gl.FLOAT, texels);
  }

  /** Render parts, see `drawOne`, and sum them by their `weight`. */
  draw(parts, target) {
    const many = parts.length > 1;
    parts.forEach((part, k) => {
      this.drawOne(part, target);
      if (many) this.mix(part.weight, k === 0);
    });
    this.result = many ? this.mixed : this.rendered;
    this.compositing = parts[0].model.header.compositing;
  }

  /** Add the rendered part to the sum. */
  mix(weight, begin) {
    const { gl, rendered, blend: { made, at } } = this;
    this.mixed.bind(rendered.width, rendered.height, rendered.format);
    gl.clearColor(0, 0, 0, 0);
    if (begin) gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(made);
    gl.bindVertexArray(null);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, rendered.texture);
    gl.uniform1i(at.rendered, 0);
    gl.uniform1f(at.weight, weight);
    gl.uniform4fv(at.onScreen, UPRIGHT);
    gl.uniform4fv(at.inTarget, ALL_OF_IT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.BLEND);
  }

  /**
   * Render the listed Gaussians of a model, front to back, at a time, into width x height pixels. Of the target: `unit`,
   * pixels per unit of model space; `origin`, the frame's center; `lowPass` in px^2; `isExact`: in single precision.
   */
  drawOne({ model, instances, time, highlight }, { width, height, unit, origin, lowPass, isExact }) {
    const { gl, splat: { made, at } } = this, { header } = model, { options } = header;
    const gaussians = this.take(model);
    this.rendered.bind(width, height, isExact ? this.exact : this.fast);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 1); // alpha holds the transmittance
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (instances.length === 0) return;
    gl.useProgram(made);
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    gl.bufferData(gl.ARRAY_BUFFER, instances, gl.STREAM_DRAW);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, gaussians);
    this.takeMaps(model, time);
    gl.uniform1i(at.gaussians, 0);
    gl.uniform1i(at.maps, 2);
    gl.uniform1i(at.texels, model.texels);
    gl.uniform1i(at.degree, model.degree);
    gl.uniform1f(at.time, time);
    gl.uniform1f(at.envelopePower, header.power);
    gl.uniform1f(at.envelopeFloor, header.floor);
    gl.uniform1f(at.unit, unit);
    gl.uniform2fv(at.origin, origin);
    gl.uniform2f(at.target, width, height);
    gl.uniform1f(at.lowPass, lowPass);
    gl.uniform1f(at.cutoff, options.alpha_cutoff);
    gl.uniform1f(at.ceiling, options.alpha_ceiling);
    gl.uniform1f(at.support, options.support_radius === null ? NO_BOUND : options.support_radius ** 2);
    gl.uniform1f(at.highlight, highlight);
    gl.uniform3fv(at.tint, TINT);
    gl.enable(gl.BLEND);
    // Front to back: colors are weighted by the transmittance, which each Gaussian reduces, except in sums.
    if (header.compositing === "sum") gl.blendFuncSeparate(gl.ONE, gl.ONE, gl.ZERO, gl.ONE);
    else gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, instances.length);
    gl.disable(gl.BLEND);
  }

  /** Set the original's frame for later calls of `put`. */
  setOriginal(image) {
    const { gl } = this;
    if (image === this.originalShown) return;
    this.originalShown = image;
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.original);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
  }

  /** Clear the screen. */
  clear(width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** Show a part of the rendered image or of the original. Rectangles are (left, top, width, height), as fractions. */
  put(what, onScreen, inPicture, inTarget, background, gain = 4) {
    const { gl, show: { made, at } } = this;
    gl.useProgram(made);
    gl.bindVertexArray(null);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.result.texture);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.original);
    gl.uniform1i(at.rendered, 0);
    gl.uniform1i(at.original, 1);
    gl.uniform1i(at.what, what);
    gl.uniform1f(at.gain, gain);
    gl.uniform3fv(at.background, this.compositing === "sum" ? [0, 0, 0] : background);
    gl.uniform4fv(at.onScreen, onScreen);
    gl.uniform4fv(at.inPicture, inPicture);
    gl.uniform4fv(at.inTarget, inTarget);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  /** The rendered image as bytes: red, green, blue, 255, the top row first. */
  read(background) {
    const { gl, result: { width, height } } = this, bytes = new Uint8Array(4 * width * height);
    this.bytes.bind(width, height, gl.RGBA8);
    this.put(WHAT.model, UPRIGHT, ALL_OF_IT, ALL_OF_IT, background);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }
}
