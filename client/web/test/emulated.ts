// An emulated phone whose camera sees one photograph: iwer's device, and the raw camera access that iwer lacks.
import { XRDevice, metaQuest3 } from "iwer";

type Emulation = { photo: string; width: number; height: number; fovy: number; position: number[]; orientation: number[] };
const { photo, width, height, fovy, position, orientation } = (globalThis as unknown as { emulation: Emulation }).emulation;

const config = { ...metaQuest3, supportedFeatures: [...metaQuest3.supportedFeatures, "camera-access", "dom-overlay"] };
const device = new XRDevice(config as typeof metaQuest3, { ipd: 0, fovy, stereoEnabled: false });
device.position.set(position[0] ?? 0, position[1] ?? 0, position[2] ?? 0);
device.quaternion.set(orientation[0] ?? 0, orientation[1] ?? 0, orientation[2] ?? 0, orientation[3] ?? 1);
device.installRuntime({ forceInstall: true });

const image = new Image();
image.src = photo;
// The emulated phone shows what it sees, as a phone's screen does.
addEventListener("DOMContentLoaded", () => {
  document.body.style.background = `url("${photo}") 0 0 / 100vw 100vh no-repeat fixed`;
});

Object.defineProperty((globalThis as unknown as { XRView: { prototype: object } }).XRView.prototype, "camera", {
  get(this: XRView) {
    return this.eye === "left" && image.complete ? { width, height } : undefined;
  },
});
const binding = (globalThis as unknown as { XRWebGLBinding: { prototype: object } }).XRWebGLBinding;
Object.assign(binding.prototype, {
  getCameraImage(): WebGLTexture {
    const gl = document.querySelector<HTMLCanvasElement>("#canvas")?.getContext("webgl2") as WebGL2RenderingContext;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    return texture;
  },
});
