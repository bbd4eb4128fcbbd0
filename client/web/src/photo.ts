// A photograph that is dropped: where it was taken, on the plan of its scene.
import { ConnectError } from "@connectrpc/connect";
import type { LocalizeResponse } from "./gen/mapless/v1/localization_service_pb.js";
import { planOf, turned, vector, type Drawn } from "./plan.js";
import { described, element, localization, parameters, references } from "./server.js";

const LONGEST_SIDE_PX = 2048;
const FILM_DIAGONAL_MM = Math.hypot(36, 24);
const FOCAL_SIGMA = 0.02; // of what a person enters

const state = { status: "", worldFromCamera: [] as number[], finalMs: 0 };
(globalThis as unknown as { mapless: typeof state }).mapless = state;
element<HTMLInputElement>("scene").value = parameters.get("scene") ?? "";
if (parameters.has("focal_px")) {
  element<HTMLInputElement>("focal").value = parameters.get("focal_px") ?? "";
  element<HTMLSelectElement>("unit").value = "px";
}

function show(status: string): void {
  state.status = status;
  element("status").textContent = status;
}

/** The photograph upright, reduced and without its metadata, which are nobody's business. */
async function prepared(file: Blob): Promise<{ image: Uint8Array; width: number; height: number; reduced: number }> {
  const bitmap = await createImageBitmap(file);
  const reduced = Math.min(1, LONGEST_SIDE_PX / Math.max(bitmap.width, bitmap.height));
  const canvas = element<HTMLCanvasElement>("photo");
  canvas.width = Math.round(bitmap.width * reduced);
  canvas.height = Math.round(bitmap.height * reduced);
  canvas.getContext("2d")?.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  const blob = await new Promise<Blob | null>((done) => canvas.toBlob(done, "image/jpeg", 0.95));
  if (!blob) throw new Error("the photograph cannot be encoded");
  return { image: new Uint8Array(await blob.arrayBuffer()), width: canvas.width, height: canvas.height, reduced };
}

function focalPx(width: number, height: number, reduced: number): number {
  const given = element<HTMLInputElement>("focal").valueAsNumber;
  if (!(given > 0)) throw new Error("give the focal length");
  const isFilm = element<HTMLSelectElement>("unit").value === "mm";
  return isFilm ? (given / FILM_DIAGONAL_MM) * Math.hypot(width, height) : given * reduced;
}

/** What the plan shows of the scene itself. */
async function sceneOf(name: string): Promise<Pick<Drawn, "references" | "down">> {
  const { scene } = await references.getScene({ name });
  const found: { name: string; pose: NonNullable<Drawn["answer"]>["pose"] }[] = [];
  let pageToken = "";
  do {
    const page = await references.listReferences({ scene: name, pageSize: 1000, pageToken });
    for (const it of page.references) if (it.worldFromCamera) found.push({ name: it.name, pose: it.worldFromCamera });
    pageToken = page.nextPageToken;
  } while (pageToken && found.length < 5000);
  const q = scene?.datum?.enuFromWorld;
  const inverse = q && { ...q, x: -q.x, y: -q.y, z: -q.z };
  const down = scene?.downInWorld ? vector(scene.downInWorld) : scene?.datum ? turned(inverse, [0, 0, -1]) : undefined;
  return { references: found, down };
}

function draw(scene: Pick<Drawn, "references" | "down">, answer: LocalizeResponse | undefined): void {
  const localized = answer?.outcome.case === "localization" ? answer.outcome.value : undefined;
  const pose = localized?.worldFromCamera;
  const debug = answer?.debug;
  const points = (debug?.pointXM ?? []).flatMap((x, i) =>
    debug?.isInlier[i] ? [[x, debug.pointYM[i] ?? 0, debug.pointZM[i] ?? 0] as const] : [],
  );
  const used = new Set(answer?.diagnostics?.references.filter((it) => it.inlierCount).map((it) => it.name));
  const covariance = localized?.covariance?.rowMajor;
  element("plan").innerHTML = planOf({ ...scene, points, used, answer: pose && { pose, ...(covariance && { covariance }) } });
  if (pose) state.worldFromCamera = [...vector(pose.translationM), pose.rotation?.x ?? 0, pose.rotation?.y ?? 0, pose.rotation?.z ?? 0, pose.rotation?.w ?? 1];
}

/** The latest photograph's; an earlier one's ends. */
let calling: AbortController | undefined;

async function localize(file: Blob): Promise<void> {
  calling?.abort();
  const { signal } = (calling = new AbortController());
  const beganMs = performance.now();
  try {
    show("Localizing ...");
    const name = `scenes/${element<HTMLInputElement>("scene").value}`;
    const { image, width, height, reduced } = await prepared(file);
    const focal = focalPx(width, height, reduced);
    const request = {
      scene: name,
      image,
      intrinsics: {
        widthPx: width,
        heightPx: height,
        focalXPx: focal,
        focalYPx: focal,
        principalXPx: (width - 1) / 2,
        principalYPx: (height - 1) / 2,
      },
      intrinsicsUncertainty: { focalSigmaPx: FOCAL_SIGMA * focal },
      options: { includeDebug: true },
    };
    const scene = await sceneOf(name);
    draw(scene, undefined);
    for await (const message of localization.localizeProgressively(request, { signal })) {
      draw(scene, message.answer);
      show(described(message.answer, message.isFinal));
    }
    state.finalMs = performance.now() - beganMs;
  } catch (error) {
    if (!signal.aborted) show(`Failed: ${error instanceof ConnectError ? error.message : error}`);
  }
}

const drop = element("drop");
const input = element<HTMLInputElement>("file");
input.addEventListener("change", () => input.files?.[0] && void localize(input.files[0]));
for (const kind of ["dragenter", "dragover"])
  drop.addEventListener(kind, (event) => {
    event.preventDefault();
    drop.classList.add("over");
  });
drop.addEventListener("dragleave", () => drop.classList.remove("over"));
drop.addEventListener("drop", (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  const file = event.dataTransfer?.files[0];
  if (file) void localize(file);
});
show("Ready.");
