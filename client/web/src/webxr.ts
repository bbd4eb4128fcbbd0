// A headset or phone: its camera image is localized, and anchors of the scene appear where they are.
//
// ?scene=hall&anchors=1,0,2;0,1,3 names the scene and the anchors, world frame, metres (default: the world's origin).
import { ConnectError } from "@connectrpc/connect";
import { AnchorPainter, placesOf } from "./anchors.js";
import { CameraReader, encoded, intrinsicsOf } from "./camera.js";
import { Axes, type LocalizeResponse } from "./gen/mapless/v1/localization_service_pb.js";
import { described, element, localization, parameters } from "./server.js";

const LONGEST_SIDE_PX = 1280; // servers compute with 1024 unless configured otherwise

// Chromium's raw camera access, which @types/webxr lacks: https://immersive-web.github.io/raw-camera-access/
type Camera = { width: number; height: number };
type ViewWithCamera = XRView & { camera?: Camera };
type BindingWithCamera = XRWebGLBinding & { getCameraImage(camera: Camera): WebGLTexture };

/** What the console and tests can see. */
const state = { intrinsicsOf, firstPoseMs: 0, finalPoseMs: 0, worldFromSession: [] as number[], status: "", frames: 0 };
(globalThis as unknown as { mapless: typeof state }).mapless = state;

element<HTMLInputElement>("scene").value = parameters.get("scene") ?? "";
const anchors = placesOf(parameters.get("anchors") ?? "0,0,0");
const startButton = element<HTMLButtonElement>("start");

function show(status: string): void {
  state.status = status;
  for (const id of ["status", "overlay-status"]) element(id).textContent = status;
}

class Session {
  private sessionFromWorld: Float32Array | undefined;
  private isWanted = true;
  private calling: AbortController | undefined;

  private constructor(
    private readonly session: XRSession,
    private readonly space: XRReferenceSpace,
    private readonly gl: WebGL2RenderingContext,
    private readonly binding: BindingWithCamera,
    private readonly reader: CameraReader,
    private readonly painter: AnchorPainter,
    private askedMs: number,
    ended: () => void,
  ) {
    session.addEventListener("end", () => {
      this.calling?.abort();
      ended();
    });
    // What the device tracks begins anew: the earlier answer means nothing any more.
    space.addEventListener("reset", () => this.localize());
    session.requestAnimationFrame(this.onFrame);
  }

  static async start(ended: () => void): Promise<Session> {
    const askedMs = performance.now();
    if (!navigator.xr) throw new Error("this browser has no WebXR, or the page is not encrypted (https)");
    const overlay = { root: element("overlay") };
    const session = await navigator.xr.requestSession("immersive-ar", {
      requiredFeatures: ["camera-access"],
      optionalFeatures: ["dom-overlay"],
      domOverlay: overlay,
    });
    const canvas = element<HTMLCanvasElement>("canvas");
    const gl = canvas.getContext("webgl2", { xrCompatible: true, alpha: true }) as WebGL2RenderingContext;
    await session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
    const space = await session.requestReferenceSpace("local");
    const binding = new XRWebGLBinding(session, gl) as BindingWithCamera;
    return new Session(session, space, gl, binding, new CameraReader(gl), new AnchorPainter(gl), askedMs, ended);
  }

  /** Localizes with the next camera image. */
  localize(): void {
    this.isWanted = true;
    this.askedMs = performance.now();
    state.firstPoseMs = state.finalPoseMs = 0;
  }

  private readonly onFrame = (_: number, frame: XRFrame): void => {
    this.session.requestAnimationFrame(this.onFrame);
    const layer = this.session.renderState.baseLayer;
    const pose = frame.getViewerPose(this.space);
    if (!layer || !pose) return;
    state.frames++;
    const gl = this.gl;
    for (const view of pose.views as readonly ViewWithCamera[]) {
      if (this.isWanted && view.camera) {
        this.isWanted = false;
        void this.ask(view, view.camera);
      }
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!this.sessionFromWorld) return;
    for (const view of pose.views) {
      const viewport = layer.getViewport(view);
      if (!viewport?.width) continue;
      gl.viewport(viewport.x, viewport.y, viewport.width, viewport.height);
      this.painter.paint(view.projectionMatrix, view.transform.inverse.matrix, this.sessionFromWorld, anchors);
    }
  };

  /** Sends a view's camera image; a call that still runs ends, because its image is older. */
  private async ask(view: ViewWithCamera, camera: Camera): Promise<void> {
    const reduced = Math.min(1, LONGEST_SIDE_PX / Math.max(camera.width, camera.height));
    const [width, height] = [Math.round(camera.width * reduced), Math.round(camera.height * reduced)];
    const pixels = this.reader.read(this.binding.getCameraImage(camera), width, height);
    const { position, orientation } = view.transform;
    const request = {
      scene: `scenes/${element<HTMLInputElement>("scene").value}`,
      intrinsics: intrinsicsOf(view.projectionMatrix, width, height),
      sessionFromCamera: {
        rotation: { x: orientation.x, y: orientation.y, z: orientation.z, w: orientation.w },
        translationM: { x: position.x, y: position.y, z: position.z },
      },
      options: { axes: Axes.ARCORE }, // x right, y up, z backward, as WebXR's
    };
    this.calling?.abort();
    const calling = (this.calling = new AbortController());
    show("Localizing ...");
    try {
      const image = await encoded(pixels);
      for await (const message of localization.localizeProgressively({ ...request, image }, { signal: calling.signal }))
        this.apply(message.answer, message.isFinal);
    } catch (error) {
      if (!calling.signal.aborted) show(`Failed: ${ConnectError.from(error).message}`);
    }
  }

  private apply(answer: LocalizeResponse | undefined, isFinal: boolean): void {
    show(described(answer, isFinal));
    const pose = answer?.outcome.case === "localization" ? answer.outcome.value.inAxes?.worldFromSession : undefined;
    if (!pose?.rotation || !pose.translationM) {
      this.sessionFromWorld = undefined; // also where a rejection follows a pose
      return;
    }
    const worldFromSession = new XRRigidTransform({ ...pose.translationM, w: 1 }, pose.rotation);
    this.sessionFromWorld = worldFromSession.inverse.matrix;
    state.worldFromSession = [...worldFromSession.matrix];
    const elapsedMs = performance.now() - this.askedMs;
    state.firstPoseMs ||= elapsedMs;
    if (isFinal) state.finalPoseMs = elapsedMs;
  }

  end(): void {
    void this.session.end();
  }
}

function inSession(isRunning: boolean): void {
  element("overlay").hidden = !isRunning;
  element("page").hidden = isRunning;
}

startButton.addEventListener("click", async () => {
  try {
    const running = await Session.start(() => inSession(false));
    inSession(true);
    element("again").onclick = () => running.localize();
    element("end").onclick = () => running.end();
  } catch (error) {
    show(`Cannot start: ${error instanceof Error ? error.message : error}`);
  }
});
show("Ready.");
