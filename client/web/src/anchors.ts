// Anchors: places in the scene's world, drawn as crosses of three coloured axes.
import { linked } from "./camera.js";

// Lines are a pixel wide everywhere; an axis is two crossed strips, 0.3 m long and 1 cm wide, of two triangles each.
const VERTICES = `#version 300 es
uniform mat4 matrix;
out vec3 colour;
const float ALONG[6] = float[](0.0, 1.0, 0.0, 0.0, 1.0, 1.0);
const float ASIDE[6] = float[](-1.0, -1.0, 1.0, 1.0, -1.0, 1.0);
void main() {
  int axis = gl_VertexID / 12, side = (axis + 1 + gl_VertexID / 6 % 2) % 3, corner = gl_VertexID % 6;
  vec3 place = vec3(0);
  place[axis] = 0.3 * ALONG[corner];
  place[side] = 0.005 * ASIDE[corner];
  colour = vec3(axis == 0, axis == 1, axis == 2);
  gl_Position = matrix * vec4(place, 1);
}`;
const FRAGMENTS = `#version 300 es
precision mediump float;
in vec3 colour;
out vec4 painted;
void main() { painted = vec4(colour, 1); }`;

/** The product of two 4x4 matrices by columns. */
export function product(a: ArrayLike<number>, b: ArrayLike<number>): Float32Array {
  const result = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let i = 0; i < 4; i++)
        result[4 * column + row] = (result[4 * column + row] ?? 0) + (a[4 * i + row] ?? 0) * (b[4 * column + i] ?? 0);
  return result;
}

/** "1,0,2;0,0,1" is two places. */
export function placesOf(text: string): number[][] {
  return text.split(";").map((place) => place.split(",").map(Number)).filter((it) => it.length === 3 && it.every(Number.isFinite));
}

/** Draws anchors in the current framebuffer and viewport. */
export class AnchorPainter {
  private readonly program: WebGLProgram;

  constructor(private readonly gl: WebGL2RenderingContext) {
    this.program = linked(gl, VERTICES, FRAGMENTS);
  }

  /**
   * @param projection, viewFromSession of a view.
   * @param sessionFromWorld from the answer.
   * @param places of the anchors, world frame, metres.
   */
  paint(projection: Float32Array, viewFromSession: Float32Array, sessionFromWorld: Float32Array, places: number[][]): void {
    const gl = this.gl;
    const clipFromWorld = product(projection, product(viewFromSession, sessionFromWorld));
    gl.useProgram(this.program);
    for (const [x, y, z] of places) {
      const worldFromAnchor = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x ?? 0, y ?? 0, z ?? 0, 1];
      const matrix = gl.getUniformLocation(this.program, "matrix");
      gl.uniformMatrix4fv(matrix, false, product(clipFromWorld, worldFromAnchor));
      gl.drawArrays(gl.TRIANGLES, 0, 36);
    }
  }
}
