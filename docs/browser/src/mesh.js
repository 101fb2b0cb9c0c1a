// A visitor's mesh as a convex body.

const LARGEST = 0.09; // m, of its longest side: the open fingers have 110 mm
const SMALLEST = 0.03;
const COLOUR = [0.09, 0.64, 0.72];

/** Reads the corners of an OBJ file: {vertices [3 n] m about their middle, scaled}.
 *
 * A longest side above 1 is taken for millimetres. Throws an Error for a file without a volume.
 */
export function fromObj(text) {
  const lines = text.match(/^v\s.*$/gm) ?? [];
  const points = lines.map((line) => line.trim().split(/\s+/).slice(1, 4).map(Number));
  if (points.length < 4 || points.flat().some((value) => !Number.isFinite(value))) {
    throw new Error("this file has no corners of a mesh; choose an OBJ file");
  }
  const axes = [0, 1, 2].map((axis) => points.map((point) => point[axis]));
  const low = axes.map((values) => values.reduce((a, b) => Math.min(a, b)));
  const high = axes.map((values) => values.reduce((a, b) => Math.max(a, b)));
  const side = Math.max(...high.map((value, axis) => value - low[axis]));
  const unit = side > 1 ? 0.001 : 1;
  const scale = Math.min(Math.max(side * unit, SMALLEST), LARGEST) / side;
  const centred = points.map((point) =>
    point.map((value, axis) => scale * (value - 0.5 * (low[axis] + high[axis]))),
  );
  return { vertices: centred.flat(), colour: COLOUR, size: scale * side, faces: [] };
}

/** Returns the faces of the convex hull that MuJoCo made of the last mesh, in its body's frame. */
export function hullFaces(model, rotation) {
  const mesh = model.nmesh - 1;
  const geom = model.ngeom - 1;
  const graph = model.mesh_graph.subarray(model.mesh_graphadr[mesh]);
  const [corners, faces] = graph;
  const first = 2 + 2 * corners + corners + 3 * faces;
  const turn = rotation(Array.from(model.geom_quat.subarray(4 * geom, 4 * geom + 4)));
  const place = model.geom_pos.subarray(3 * geom, 3 * geom + 3);
  const point = (i) => {
    const at = 3 * (model.mesh_vertadr[mesh] + graph[first + i]);
    const local = model.mesh_vert.subarray(at, at + 3);
    return turn.map((row, axis) => row.reduce((sum, c, j) => sum + c * local[j], place[axis]));
  };
  return Array.from({ length: faces }, (_, face) =>
    plane(place, ...[0, 1, 2].map((i) => point(3 * face + i))),
  ).filter((values) => values.every(Number.isFinite));
}

/** Returns the plane [nx, ny, nz, offset m] of a triangle, its normal away from `inner`. */
function plane(inner, a, b, c) {
  const [u, v] = [b, c].map((end) => end.map((value, axis) => value - a[axis]));
  const normal = [0, 1, 2].map((i) => {
    const [j, k] = [(i + 1) % 3, (i + 2) % 3];
    return u[j] * v[k] - u[k] * v[j];
  });
  const reach = normal.reduce((sum, value, axis) => sum + value * (a[axis] - inner[axis]), 0);
  const length = Math.sign(reach) * Math.hypot(...normal);
  const unit = normal.map((value) => value / length);
  return [...unit, unit.reduce((sum, value, axis) => sum + value * a[axis], 0)];
}
