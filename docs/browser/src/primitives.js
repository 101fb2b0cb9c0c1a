// Push and grasp as set-points of the hand, as csac_jax.robot.primitives plans them.

export const PUSH = 0;
export const GRASP = 1;

/** Plans a primitive. Returns the hand's start and one set-point for each substep.
 *
 * action: {primitive, pose: [x m, y m, yaw rad]}; height: [H * W] m.
 */
export function plan(robot, view, height, action) {
  const { primitive, pose } = action;
  const [x, y, yaw] = pose;
  const isGrasp = primitive === GRASP;
  const surface = localTop(view, height, x, y, robot.fingerWidth);
  const low = Math.max(surface - robot.depths[primitive], robot.lowest);
  const around = localTop(view, height, x, y, 2 * robot.radius);
  const high = Math.max(low + robot.approachHeight, around + robot.startGap);
  const [closed, open] = robot.half;
  const opening = isGrasp ? open : closed;
  const end = isGrasp ? [x, y] : pushEnd(robot, view, x, y, yaw);
  const control = progress(robot.phases[primitive]).map(([descend, act, lift]) => {
    const z = high + (low - high) * descend + (high - low) * lift;
    const half = closed + (opening - closed) * (1 - Math.min(1.3 * act, 1));
    const place = [x + act * (end[0] - x), y + act * (end[1] - y)];
    return [...place, z, yaw, along(robot, robot.setPoints, half)];
  });
  const fingers = robot.positions.map((ends) => along(robot, ends, opening));
  return { start: [x, y, high, yaw, ...fingers], control, surface, rise: high - low };
}

/** Returns the highest surface, m, in a window of `side` m about (x, y) m. */
function localTop(view, height, x, y, side) {
  const { size, extent } = view;
  const cell = extent / size;
  const reach = 0.5 * Math.max(side, cell);
  let top = 0;
  for (let row = 0; row < size; row++) {
    if (Math.abs((row - 0.5 * (size - 1)) * cell - y) > reach) continue;
    for (let col = 0; col < size; col++) {
      const near = Math.abs((col - 0.5 * (size - 1)) * cell - x) <= reach;
      if (near) top = Math.max(top, height[row * size + col]);
    }
  }
  return top;
}

function pushEnd(robot, view, x, y, yaw) {
  const limit = 0.5 * view.extent;
  const clip = (value) => Math.min(Math.max(value, -limit), limit);
  return [clip(x + robot.pushLength * Math.cos(yaw)), clip(y + robot.pushLength * Math.sin(yaw))];
}

/** Returns the progress of each phase, 0 to 1, at every substep, [T][3]. */
function progress(phases) {
  const total = phases.reduce((sum, length) => sum + length);
  return Array.from({ length: total }, (_, step) => {
    let start = 0;
    const shares = phases.map((length) => {
      const share = (step + 1 - start) / length;
      start += length;
      return Math.min(Math.max(share, 0), 1);
    });
    shares[2] = shares[2] ** 2 * (3 - 2 * shares[2]); // a jerky lift shakes blocks loose
    return shares;
  });
}

/** Returns the number between two ends at half an opening, m, of fingers on a straight line. */
function along(robot, [closed, open], half) {
  const [low, high] = robot.half;
  return closed + ((half - low) * (open - closed)) / (high - low);
}
