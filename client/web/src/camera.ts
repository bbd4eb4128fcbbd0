// A headset's camera image, and its intrinsics from the view's projection matrix.
import type { MessageInitShape } from "@bufbuild/protobuf";
import type { CameraIntrinsicsSchema } from "./gen/mapless/v1/geometry_pb.js";

export type Intrinsics = MessageInitShape<typeof CameraIntrinsicsSchema>;

/**
 * Intrinsics of an image that covers a view.
 *
 * @param projection of the view, 4x4 by columns: camera's x right, y up, z backward, to -1..1.
 * @param width, height of the image, pixels.
 * @returns with (0, 0) the centre of the top-left pixel, y down.
 */
export function intrinsicsOf(projection: ArrayLike<number>, width: number, height: number): Intrinsics {
  const p = (column: number, row: number) => projection[4 * column + row] ?? 0;
  return {
    widthPx: width,
    heightPx: height,
    focalXPx: (p(0, 0) * width) / 2,
    focalYPx: (p(1, 1) * height) / 2,
    principalXPx: ((1 - p(2, 0)) * width) / 2 - 0.5,
    principalYPx: ((1 + p(2, 1)) * height) / 2 - 0.5,
  };
}

const VERTICES = `#version 300 es
out vec2 place;
void main() {
  place = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  gl_Position = vec4(place * 2.0 - 1.0, 0, 1);
}`;
// Textures begin at the bottom, images at the top.
const FRAGMENTS = `#version 300 es
precision mediump float;
uniform sampler2D image;
in vec2 place;
out vec4 colour;
void main() { colour = vec4(texture(image, vec2(place.x, 1.0 - place.y)).rgb, 1); }`;

/** Reads camera images. Their textures can be drawn, but not be read, and in the frame's callback alone. */
export class CameraReader {
  private readonly program: WebGLProgram;

  constructor(private readonly gl: WebGL2RenderingContext) {
    this.program = linked(gl, VERTICES, FRAGMENTS);
  }

  /** The pixels of a texture, the top row first. */
  read(texture: WebGLTexture, width: number, height: number): ImageData {
    const gl = this.gl;
    const target = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, target);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const pixels = new ImageData(width, height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(pixels.data.buffer));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(buffer);
    gl.deleteTexture(target);
    return pixels;
  }
}

/** A JPEG of pixels. */
export async function encoded(pixels: ImageData): Promise<Uint8Array> {
  const canvas = new OffscreenCanvas(pixels.width, pixels.height);
  canvas.getContext("2d")?.putImageData(pixels, 0, 0);
  const file = await canvas.convertToBlob({ type: "image/jpeg", quality: 0.92 });
  return new Uint8Array(await file.arrayBuffer());
}

/** A program of two shaders. */
export function linked(gl: WebGL2RenderingContext, vertices: string, fragments: string): WebGLProgram {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, fragments]] as const) {
    const shader = gl.createShader(kind) as WebGLShader;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "");
  return program;
}
