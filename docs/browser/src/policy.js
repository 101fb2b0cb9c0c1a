// The exported policy in onnxruntime: dense maps of a view, and the decision that follows.

import * as ort from "onnxruntime-web/wasm";

const PRIMITIVES = 2;

/** Loads the policy; `wasm` and `model` are the bytes of the runtime and of the ONNX file. */
export async function load(wasm, model) {
  ort.env.wasm.numThreads = 1; // more need a server's headers
  ort.env.wasm.wasmBinary = wasm;
  return ort.InferenceSession.create(model, { logSeverityLevel: 3 }); // errors alone
}

/** Computes the dense maps of a view, {q, cells, choice}, maps flat [P * K * h * w]. */
export async function maps(session, view, obs) {
  const colour = new ort.Tensor("float32", obs.colour, [view.size, view.size, 3]);
  const height = new ort.Tensor("float32", obs.height, [view.size, view.size]);
  const results = await session.run({ colour, height });
  const [primitive] = results.primitive.data;
  const choice = { primitive, pose: [...results.pose.data], score: results.score.data[0] };
  return { q: results.q.data, cells: results.cells.data, choice };
}

/** Returns the best action: {primitive, pose, score}, or null where there is nothing to act on.
 *
 * Cells of a primitive that are within `view.apart` of an action in `avoided` do not count.
 */
export function choose(view, { q, cells }, avoided = []) {
  const num = q.length / PRIMITIVES;
  let best = -1;
  for (let index = 0; index < q.length; index++) {
    if (!cells[index] || (best >= 0 && q[index] <= q[best])) continue;
    const primitive = Math.floor(index / num);
    const [x, y] = cellPose(view, index % num);
    const isAvoided = avoided.some(
      ({ primitive: other, pose }) =>
        other === primitive && Math.hypot(x - pose[0], y - pose[1]) < view.apart,
    );
    if (!isAvoided) best = index;
  }
  if (best < 0) return null;
  return { primitive: Math.floor(best / num), pose: cellPose(view, best % num), score: q[best] };
}

/** Returns the pose, m, m, rad, of a flat index into maps [K, h, w]. */
function cellPose({ yaws, side, cell }, index) {
  const yaw = (2 * Math.PI * Math.floor(index / side ** 2)) / yaws;
  const y = ((Math.floor(index / side) % side) - 0.5 * (side - 1)) * cell;
  const x = ((index % side) - 0.5 * (side - 1)) * cell;
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [cos * x - sin * y, sin * x + cos * y, yaw];
}

/** Returns the largest Q over yaws at the cells of the view, [P][H * W]; -Infinity where none. */
export function bestOverYaws(view, { q, cells }) {
  const { size, extent, yaws } = view;
  const nowhere = new Float32Array(size ** 2).fill(-Infinity);
  const best = Array.from({ length: PRIMITIVES }, () => nowhere.slice());
  for (let k = 0; k < yaws; k++) {
    const yaw = (2 * Math.PI * k) / yaws;
    const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
    for (let place = 0; place < size ** 2; place++) {
      const x = ((place % size) - 0.5 * (size - 1)) * (extent / size);
      const y = (Math.floor(place / size) - 0.5 * (size - 1)) * (extent / size);
      const at = [-sin * x + cos * y, cos * x + sin * y];
      for (let primitive = 0; primitive < PRIMITIVES; primitive++) {
        const value = read(view, q, cells, primitive * yaws + k, at);
        if (value > best[primitive][place]) best[primitive][place] = value;
      }
    }
  }
  return best;
}

/** Interpolates one map at (y, x) m of its frame; -Infinity if the nearest cell is not valid. */
function read({ side, cell }, q, cells, map, at) {
  const [row, col] = at.map((value) =>
    Math.min(Math.max(value / cell + 0.5 * (side - 1), 0), side - 1),
  );
  const start = map * side ** 2;
  if (!cells[start + Math.round(row) * side + Math.round(col)]) return -Infinity;
  const [top, left] = [row, col].map((value) => Math.min(Math.floor(value), side - 2));
  const [down, right] = [row - top, col - left];
  const corner = start + top * side + left;
  const above = (1 - right) * q[corner] + right * q[corner + 1];
  const below = (1 - right) * q[corner + side] + right * q[corner + side + 1];
  return (1 - down) * above + down * below;
}
