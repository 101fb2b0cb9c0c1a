// The view from straight above: heights and lit colours, as csac_jax.vision.observe computes them.

const ON_PLANE = 1e-12; // m, depth of an origin that lies on a plane

/** Returns the body's rotation, rows of a 3 x 3 matrix, of a unit quaternion (w, x, y, z). */
export function rotation([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Observes convex parts from above: one ray down through every cell's centre.
 *
 * parts: [{pose: [7], faces: [[nx, ny, nz, offset m]], colour: [3]}].
 * Returns {height: [H * W] m, colour: [H * W * 3], 0 to 1}, Float32Array.
 */
export function observe(view, parts) {
  const { size } = view;
  const height = new Float32Array(size * size);
  const colour = new Float32Array(3 * size * size);
  const table = shade(view, view.table, [0, 0, 1]);
  for (let cell = 0; cell < size * size; cell++) colour.set(table, 3 * cell);
  for (const part of parts) cover(view, inWorld(view, part), height, colour);
  return { height, colour };
}

/** Converts a part's faces to planes of the world: normal, offset m, lit colour. */
function inWorld(view, { pose, faces, colour }) {
  const turn = rotation(pose.slice(3));
  return faces.map(([nx, ny, nz, offset]) => {
    const normal = turn.map((row) => dot(row, [nx, ny, nz]));
    return { normal, offset: offset + dot(normal, pose), lit: shade(view, colour, normal) };
  });
}

/** Lights a colour, as csac_jax.vision.camera. */
function shade(view, colour, normal) {
  const share = view.ambient + (1 - view.ambient) * Math.max(dot(normal, view.light), 0);
  return colour.map((value) => share * value);
}

/** Writes the cells in which a part is the highest. */
function cover(view, planes, height, colour) {
  const { size, extent } = view;
  const cell = extent / size;
  for (let row = 0; row < size; row++) {
    const y = (row - 0.5 * (size - 1)) * cell;
    for (let col = 0; col < size; col++) {
      const hit = cast(planes, (col - 0.5 * (size - 1)) * cell, y, view.from);
      const index = row * size + col;
      if (hit === null || hit.z <= height[index]) continue;
      height[index] = hit.z;
      colour.set(hit.lit, 3 * index);
    }
  }
}

/** Casts a ray down from (x, y, z) m on the half-spaces of a part: {z m, lit}, or null. */
function cast(planes, x, y, z) {
  let enter = -Infinity;
  let leave = Infinity;
  let lit = null;
  for (const plane of planes) {
    const speed = -plane.normal[2];
    const depth = plane.offset - dot(plane.normal, [x, y, z]) + ON_PLANE; // not negative inside
    if (speed < 0) {
      const crossing = depth / speed;
      if (crossing > enter) {
        enter = crossing;
        lit = plane.lit;
      }
    } else if (speed > 0) leave = Math.min(leave, depth / speed);
    else if (depth < 0) return null;
  }
  return enter >= 0 && enter <= leave ? { z: z - enter, lit } : null;
}
