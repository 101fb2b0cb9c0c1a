// The table, the hand and the blocks in MuJoCo, stepped as csac_jax.sim.c_physics does.

import { GRASP } from "./primitives.js";
import { Trace, grade, lifted } from "./outcome.js";

const REACH = 1; // m from the centre; a block in play that is farther is a sign of bad physics
const CONES = { cone: 1, impratio: 10, iterations: 20, ls_iterations: 50 }; // with an own object

/** A model, and the scene whose blocks are in it. N = block slots.
 *
 * A scene is {pose: Float32Array [N * 7], velocity: Float32Array [N * 6], inPlay: [N]}.
 */
export class World {
  /** `own` is an object beside the blocks, of mesh.js, or null. */
  constructor(engine, content, own = null) {
    Object.assign(this, { engine, content, own });
    const { addresses, mjcf } = content;
    this.blocks = addresses.slots.length;
    this.slots = this.blocks + (own ? 1 : 0);
    this.model = engine.MjModel.from_xml_string(own ? withOwn(mjcf, own, this.blocks) : mjcf);
    this.data = new engine.MjData(this.model);
    const joint = this.model.njnt - 1;
    const last = own ? [this.model.jnt_qposadr[joint], this.model.jnt_dofadr[joint]] : [];
    this.qpos = [...addresses.qpos, ...last.slice(0, 1)];
    this.dofs = [...addresses.dofs, ...last.slice(1)];
    this.types = [this.model.geom_contype.slice(), this.model.geom_conaffinity.slice()];
    if (own) Object.assign(this.model.opt, CONES);
  }

  /** Frees MuJoCo's memory. */
  delete() {
    this.data.delete();
    this.model.delete();
  }

  /** Puts the blocks of a scene of the content into the model; returns the scene. */
  load(number) {
    const { model, content } = this;
    const { geoms, bodies, inertiaFrames } = content.addresses;
    const source = content.scenes[number];
    const { mesh_vert, friction, ...fields } = source.fields;
    for (const [name, rows] of Object.entries(fields)) {
      putRows(model[name], name.startsWith("geom") ? geoms : bodies, rows);
    }
    putRows(model.body_iquat, bodies, inertiaFrames);
    geoms.forEach((geom, i) => (model.geom_friction[3 * geom] = Math.fround(friction[i])));
    model.mesh_vert.set(Float32Array.from(mesh_vert.flat()));
    this.colours = source.colour;
    const scene = this.empty();
    scene.pose.set(source.pose.flat());
    source.inPlay.forEach((is, slot) => (scene.inPlay[slot] = is));
    return this.park(scene);
  }

  /** Returns a scene without blocks. */
  empty() {
    const pose = new Float32Array(7 * this.slots);
    const velocity = new Float32Array(6 * this.slots);
    return this.park({ pose, velocity, inPlay: Array(this.slots).fill(false) });
  }

  /** Moves the blocks out of play to their places. */
  park(scene) {
    scene.inPlay.forEach((is, slot) => {
      if (is) return;
      const place = this.content.addresses.parking[slot] ?? [3 + 0.3 * slot, 0, 1];
      scene.pose.set([...place, 1, 0, 0, 0], 7 * slot);
      scene.velocity.fill(0, 6 * slot, 6 * slot + 6);
    });
    return scene;
  }

  /** Begins at a scene, the hand at `robot`: positions of its joints. */
  begin(scene, robot) {
    const { engine, model, data, content } = this;
    const [contype, conaffinity] = this.types;
    for (let geom = 0; geom < model.ngeom; geom++) {
      const slot = content.addresses.slotOfGeom[geom] ?? this.blocks;
      const parked = slot >= 0 && !scene.inPlay[slot];
      model.geom_contype[geom] = parked ? 0 : contype[geom];
      model.geom_conaffinity[geom] = parked ? 0 : conaffinity[geom];
    }
    engine.mj_setConst(model, data);
    engine.mj_resetData(model, data);
    content.addresses.robot.forEach((address, i) => (data.qpos[address] = Math.fround(robot[i])));
    for (let slot = 0; slot < this.slots; slot++) {
      data.qpos.set(scene.pose.subarray(7 * slot, 7 * slot + 7), this.qpos[slot]);
      data.qvel.set(scene.velocity.subarray(6 * slot, 6 * slot + 6), this.dofs[slot]);
    }
    this.scene = scene;
  }

  /** Steps once, and holds the speed of blocks in play to its limit. */
  step(control) {
    const { data } = this;
    data.ctrl.set(Float32Array.from(control));
    this.engine.mj_step(this.model, data);
    const most = this.content.judge.speed;
    const velocity = data.qvel;
    for (let slot = 0; slot < this.slots; slot++) {
      if (!this.scene.inPlay[slot]) continue;
      for (let axis = 0; axis < 6; axis++) {
        const at = this.dofs[slot] + axis;
        velocity[at] = Math.min(Math.max(velocity[at], -most[axis]), most[axis]);
      }
    }
  }

  /** Returns the scene as it is now. */
  now() {
    const { data, scene } = this;
    const after = this.empty();
    after.inPlay = [...scene.inPlay];
    for (let slot = 0; slot < this.slots; slot++) {
      after.pose.set(data.qpos.subarray(this.qpos[slot], this.qpos[slot] + 7), 7 * slot);
      after.velocity.set(data.qvel.subarray(this.dofs[slot], this.dofs[slot] + 6), 6 * slot);
    }
    return this.park(after);
  }

  /** Returns if palm, low and high pad touch each block, [3][N], as the last step began. */
  touching() {
    const found = this.data.sensordata;
    const at = (part, slot) =>
      slot < this.blocks ? part * this.blocks + slot : 3 * this.blocks + part;
    const slots = Array.from({ length: this.slots }, (_, slot) => slot);
    return [0, 1, 2].map((part) => slots.map((slot) => found[at(part, slot)] > 0));
  }

  /** Returns the convex parts of a scene's objects, for heights.js. */
  parts(number, scene) {
    const { addresses, scenes, view } = this.content;
    const pose = (slot) => Array.from(scene.pose.subarray(7 * slot, 7 * slot + 7));
    const parts = scenes[number].faces.map((faces, part) => {
      const slot = addresses.slotOfPart[part];
      return { slot, faces, pose: pose(slot), colour: view.colours[this.colours[slot]] };
    });
    if (this.own) {
      const slot = this.blocks;
      parts.push({ slot, faces: this.own.faces, pose: pose(slot), colour: this.own.colour });
    }
    return parts.filter(({ slot }) => scene.inPlay[slot]);
  }
}

function putRows(array, rows, values) {
  const width = Array.isArray(values[0]) ? values[0].length : 1;
  rows.forEach((row, i) => array.set(Float32Array.of(...[values[i]].flat()), width * row));
}

/** Adds an object of one mesh as the last body, with its touch sensors. */
function withOwn(mjcf, own, slot) {
  const name = `block${slot}`;
  const vertices = own.vertices.join(" ");
  const mesh = `<mesh name="own" inertia="convex" maxhullvert="64" vertex="${vertices}"/>`;
  const body = `<body name="${name}" pos="${3 + 0.3 * slot} 0 1"><joint name="${name}" type="free"/>
    <geom class="blocks/block" type="mesh" mesh="own"/></body>`;
  const sensors = ["palm", "pad_low", "pad_high"].map(
    (part) => `<contact geom1="hand/${part}" body2="${name}"/>`,
  );
  return mjcf
    .replace("</asset>", `${mesh}</asset>`)
    .replace("</worldbody>", `${body}</worldbody>`)
    .replace("</sensor>", `${sensors.join("")}</sensor>`);
}

/** One primitive of the robot, substep by substep. */
export class Motion {
  constructor(world, scene, plan, primitive) {
    Object.assign(this, { world, before: scene, plan, primitive, count: 0 });
    this.trace = new Trace(world.slots);
    world.begin(scene, plan.start);
  }

  get done() {
    return this.count === this.plan.control.length;
  }

  step() {
    const { world, before } = this;
    world.step(this.plan.control[this.count++]);
    const qpos = world.data.qpos;
    const rise = world.qpos.map((address, slot) => qpos[address + 2] - before.pose[7 * slot + 2]);
    const inPlay = before.inPlay;
    this.trace.add(world.touching(), rise.map((value, slot) => (inPlay[slot] ? value : 0)));
  }

  /** Returns the scene without blocks that are gone, and what the primitive did. */
  result() {
    const { world, trace, plan } = this;
    const { judge, view } = world.content;
    const scene = world.now();
    if (!isHealthy(scene)) return { scene: this.before, outcome: 0, lifted: [], lost: [] };
    const isGrasp = this.primitive === GRASP;
    const up = lifted(judge, trace, plan.rise).map((is) => is && isGrasp);
    const lost = up.map((is, slot) => scene.inPlay[slot] && !is && !isInside(view, scene, slot));
    scene.inPlay = scene.inPlay.map((is, slot) => is && !up[slot] && !lost[slot]);
    const outcome = isGrasp ? grade(judge, trace, plan.surface, plan.rise) : 0;
    return { scene: world.park(scene), outcome, lifted: slots(up), lost: slots(lost) };
  }
}

/** Blocks that fall and come to rest, the hand far above. */
export class Fall {
  constructor(world, scene, time) {
    const { addresses, robot } = world.content;
    this.world = world;
    this.left = Math.round(time / robot.timestep);
    const closed = robot.positions.map((ends) => ends[0]);
    this.control = [0, 0, addresses.parkedHand, 0, robot.setPoints[0]];
    world.begin(scene, [0, 0, addresses.parkedHand, 0, ...closed]);
  }

  get done() {
    return this.left <= 0;
  }

  step() {
    this.world.step(this.control);
    this.left -= 1;
  }

  /** Returns the scene at rest, without blocks that left the workspace. */
  result() {
    const { world } = this;
    const scene = world.now();
    const { view } = world.content;
    const lost = scene.inPlay.map((is, slot) => is && !isInside(view, scene, slot));
    scene.inPlay = scene.inPlay.map((is, slot) => is && !lost[slot]);
    scene.velocity.fill(0);
    return { scene: world.park(scene), lost: slots(lost) };
  }
}

const slots = (flags) => flags.flatMap((is, slot) => (is ? [slot] : []));

function isInside(view, scene, slot) {
  const place = scene.pose.subarray(7 * slot, 7 * slot + 2);
  return place.every((value) => Math.abs(value) <= 0.5 * view.extent);
}

function isHealthy(scene) {
  return scene.inPlay.every((is, slot) => {
    const place = scene.pose.subarray(7 * slot, 7 * slot + 3);
    return !is || place.every((value) => Math.abs(value) < REACH); // NaN is not
  });
}
