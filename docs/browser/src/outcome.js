// What a primitive did, by ground truth, as csac_jax.sim.outcome judges it.

export const NAMES = ["nothing", "empty", "touched", "dropped", "lifted"];

/** Sensor readings of a whole primitive, summed up substep by substep. N = block slots. */
export class Trace {
  constructor(slots) {
    this.touched = false; // the hand met a block
    this.held = Array(slots).fill(false); // in the grip in the last substep
    this.rise = Array(slots).fill(0); // m, in the last substep
    this.heldRise = Array(slots).fill(0); // m, the largest in the grip
  }

  /** Adds a substep: `touching` [3][N] of palm and pads, `rise` [N] m. */
  add(touching, rise) {
    const [low, high] = touching.slice(1);
    const grips = low.some(Boolean) && high.some(Boolean);
    this.touched ||= touching.some((row) => row.some(Boolean));
    this.rise = rise;
    this.held = rise.map((_, slot) => grips && (low[slot] || high[slot]));
    this.heldRise = this.heldRise.map((most, slot) =>
      this.held[slot] ? Math.max(most, rise[slot]) : most,
    );
  }
}

/** Returns which blocks rose with the hand, by `handRise` m, which holds something, [N]. */
export function lifted(judge, trace, handRise) {
  const holds = trace.held.some(Boolean);
  return trace.rise.map((rise) => holds && rise >= judge.liftShare * handRise);
}

/** Judges a grasp: a number of NAMES. `surface` m is the one it was planned for. */
export function grade(judge, trace, surface, handRise) {
  const dropped = trace.touched && trace.heldRise.some((rise) => rise >= judge.gripRise);
  const holds = [surface >= judge.bare, trace.touched, dropped];
  holds.push(lifted(judge, trace, handRise).some(Boolean));
  return holds.lastIndexOf(true) + 1;
}
