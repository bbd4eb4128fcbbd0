// The scene from above: its references, matched points, and the answer with its 95 % ellipse.
import type { Quaternion, RigidTransform, Vector3 } from "./gen/mapless/v1/geometry_pb.js";

const [WIDTH, HEIGHT, MARGIN, WEDGE] = [640, 480, 40, 22];
const CHI2_95_IN_PLANE = -2 * Math.log(0.05);
type Vector = readonly [number, number, number];
type Pixel = readonly [number, number];

export interface Drawn {
  references: readonly { name: string; pose: RigidTransform }[];
  used: ReadonlySet<string>;
  points: readonly Vector[];
  answer?: { pose: RigidTransform; covariance?: readonly number[] } | undefined;
  down?: Vector | undefined;
}

const dot = (a: Vector, b: Vector) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
const unit = (a: Vector): Vector => {
  const length = Math.hypot(...a) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
};
export const vector = (it: Vector3 | undefined): Vector => [it?.x ?? 0, it?.y ?? 0, it?.z ?? 0];

/** A vector turned by a unit quaternion. */
export function turned(q: Quaternion | undefined, v: Vector): Vector {
  const [axis, w]: [Vector, number] = [[q?.x ?? 0, q?.y ?? 0, q?.z ?? 0], q?.w ?? 1];
  const t = cross(axis, v).map((it) => 2 * it) as unknown as Vector;
  const u = cross(axis, t);
  return [v[0] + w * t[0] + u[0], v[1] + w * t[1] + u[1], v[2] + w * t[2] + u[2]];
}

/** The drawing as SVG. */
export function planOf(drawn: Drawn): string {
  const poses = [...drawn.references.map((it) => it.pose), ...(drawn.answer ? [drawn.answer.pose] : [])];
  if (!poses.length) return "";
  // Where nothing says what is down, cameras are held upright on average: their y axis points down.
  const sum = poses.map((it) => turned(it.rotation, [0, 1, 0])).reduce((a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]]);
  const up = unit((drawn.down ?? sum).map((it) => -it) as unknown as Vector);
  const right = unit(cross(Math.abs(up[1]) > 0.9 ? [0, 0, -1] : [0, 1, 0], up));
  const ahead = cross(up, right);
  const flat = (v: Vector): Pixel => [dot(v, right), dot(v, ahead)];
  const cameras = poses.map((it) => flat(vector(it.translationM)));
  const points = drawn.points.map(flat);
  const [low, high] = [Math.min, Math.max].map((of) =>
    [0, 1].map((i) => of(...[...cameras, ...points].map((it) => it[i] ?? 0))),
  ) as [number[], number[]];
  const sizes = [0, 1].map((i) => Math.max((high[i] ?? 0) - (low[i] ?? 0), 1e-6));
  const scale = Math.min((WIDTH - 2 * MARGIN) / (sizes[0] ?? 1), (HEIGHT - 2 * MARGIN) / (sizes[1] ?? 1));
  const place = ([x, y]: Pixel): Pixel => [
    MARGIN + (x - (low[0] ?? 0)) * scale,
    HEIGHT - MARGIN - (y - (low[1] ?? 0)) * scale,
  ];
  const wedge = (pose: RigidTransform, kind: string, title: string) => {
    const [x, y] = place(flat(vector(pose.translationM)));
    const corners = [-0.5, 0.5].map((side) => {
      const [dx, dy] = flat(turned(pose.rotation, [side, 0, 1]));
      return `${(x + WEDGE * dx).toFixed(1)},${(y - WEDGE * dy).toFixed(1)}`;
    });
    const shape = `<polygon class="${kind}" points="${x.toFixed(1)},${y.toFixed(1)} ${corners.join(" ")}">`;
    return `${shape}<title>${escaped(title)}</title></polygon>`;
  };
  const parts = points.map((it) => {
    const [x, y] = place(it);
    return `<circle class="point" cx="${x.toFixed(1)}" cy="${y.toFixed(1)}" r="1.2"/>`;
  });
  for (const { name, pose } of drawn.references)
    parts.push(wedge(pose, drawn.used.has(name) ? "used" : "reference", name.split("/").at(-1) ?? name));
  if (drawn.answer) {
    const { pose, covariance } = drawn.answer;
    parts.push(wedge(pose, covariance ? "answer" : "answer coarse", "the photograph"));
    if (covariance) parts.push(ellipse(covariance, right, ahead, place(flat(vector(pose.translationM))), scale));
  }
  parts.push(scaleBar(scale));
  return `<svg viewBox="0 0 ${WIDTH} ${HEIGHT}" role="img" aria-label="plan of the scene">${parts.join("")}</svg>`;
}

/** The 95 % ellipse of a position; `covariance` has 6x6 numbers, position first. */
function ellipse(covariance: readonly number[], right: Vector, ahead: Vector, [x, y]: Pixel, scale: number): string {
  const at = (a: Vector, b: Vector) => {
    let value = 0;
    for (let i = 0; i < 3; i++)
      for (let j = 0; j < 3; j++) value += (a[i] ?? 0) * (covariance[6 * i + j] ?? 0) * (b[j] ?? 0);
    return value;
  };
  const [xx, xy, yy] = [at(right, right), at(right, ahead), at(ahead, ahead)];
  const [mean, spread] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
  const radius = (variance: number) => Math.max(scale * Math.sqrt(CHI2_95_IN_PLANE * Math.max(variance, 0)), 3);
  const angle = (-0.5 * Math.atan2(2 * xy, xx - yy) * 180) / Math.PI;
  const radii = `rx="${radius(mean + spread).toFixed(1)}" ry="${radius(mean - spread).toFixed(1)}"`;
  const turn = `transform="rotate(${angle.toFixed(1)} ${x.toFixed(1)} ${y.toFixed(1)})"`;
  return `<ellipse class="answer" cx="${x.toFixed(1)}" cy="${y.toFixed(1)}" ${radii} ${turn}/>`;
}

/** A bar of a round length. */
function scaleBar(scale: number): string {
  const most = 120 / scale;
  const power = 10 ** Math.floor(Math.log10(most));
  const length = ([5, 2, 1].find((it) => it * power <= most) ?? 1) * power;
  const [x, y] = [MARGIN, HEIGHT - 14];
  const label = length < 1 ? `${+(100 * length).toPrecision(3)} cm` : `${+length.toPrecision(3)} m`;
  const bar = `<path d="M${x} ${y}h${(length * scale).toFixed(1)}" stroke="#444" stroke-width="2"/>`;
  return `${bar}<text x="${x + length * scale + 8}" y="${y + 5}">${label}</text>`;
}

function escaped(text: string): string {
  return text.replace(/[&<>"']/g, (it) => `&#${it.charCodeAt(0)};`);
}
