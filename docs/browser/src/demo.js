// The demonstration: a scene, the policy's decision on it, and what moves.

import { observe, rotation } from "./heights.js";
import { fromObj, hullFaces } from "./mesh.js";
import { NAMES } from "./outcome.js";
import { bestOverYaws, choose, maps } from "./policy.js";
import { GRASP, PUSH, plan } from "./primitives.js";
import { Fall, Motion, World } from "./world.js";

const REST = [0.25, 0.3, 0.1, 0]; // m, rad: where the hand waits and puts down what it took
const TRAVEL = 0.35; // s, of the hand between two places
const SETTLE = 2.5; // s, in which dropped blocks come to rest
const DROP = { side: 0.2, height: 0.12, spacing: 0.1 }; // m
const LONGEST_FRAME = 0.05; // s of physics in a frame; a slower one slows the picture down
const MOST_ACTIONS = 25;

/** The hand on its way without physics, with the blocks that it carries. */
class Travel {
  constructor(world, to, carried = []) {
    const { robot, addresses } = world.content;
    Object.assign(this, { world, carried, count: 0, total: Math.round(TRAVEL / robot.timestep) });
    this.robot = addresses.robot;
    this.from = this.robot.map((address) => world.data.qpos[address]);
    this.to = to.concat(this.from.slice(to.length));
  }

  get done() {
    return this.count === this.total;
  }

  step() {
    const { world, from, to } = this;
    const { qpos } = world.data;
    const share = ++this.count / this.total;
    const smooth = share ** 2 * (3 - 2 * share);
    this.robot.forEach((address, i) => {
      const value = from[i] + smooth * (to[i] - from[i]);
      const step = value - qpos[address];
      if (i < 3) this.carried.forEach((slot) => (qpos[world.qpos[slot] + i] += step));
      qpos[address] = value;
    });
    world.engine.mj_kinematics(world.model, world.data);
  }
}

/** A scene on the table that the policy clears. `page` shows it: see main.js. */
export class Demo {
  constructor(engine, session, content, page) {
    Object.assign(this, { engine, session, content, page, speed: 0.5, running: false });
    this.world = new World(engine, content);
    this.hand = [...REST, ...content.robot.positions.map((ends) => ends[1])];
    this.times = { decisions: [], frames: [] }; // ms of each, frames/s of each animation
  }

  /** Starts with a scene of the content. */
  async load(number) {
    this.number = number;
    this.scene = this.world.load(number);
    this.start = this.scene;
    await this.restart(this.scene);
  }

  async restart(scene) {
    Object.assign(this, { avoided: [], actions: 0 });
    this.page.build(this.world);
    await this.show(scene);
  }

  /** Shows a scene at rest, and decides about it. */
  async show(scene) {
    this.scene = scene;
    this.place(scene);
    await this.decide();
  }

  /** Puts a scene and the waiting hand into MuJoCo and draws them, without physics. */
  place(scene) {
    this.world.begin(scene, this.hand);
    this.engine.mj_kinematics(this.world.model, this.world.data);
    this.page.draw(this.world, scene.inPlay);
  }

  /** Observes the scene and finds the best action; draws the maps. */
  async decide() {
    const begun = performance.now();
    const { view } = this.content;
    this.obs = observe(view, this.world.parts(this.number, this.scene));
    this.maps = await maps(this.session, view, this.obs);
    this.decision = choose(view, this.maps, this.avoided) ?? choose(view, this.maps);
    this.times.decisions.push(performance.now() - begun);
    this.page.showMaps(this.obs, bestOverYaws(view, this.maps), this.decision);
    return this.decision;
  }

  /** Steps what moves as time passes and draws each frame; resolves when it is done. */
  animate(mover) {
    const { timestep } = this.content.robot;
    const begun = performance.now();
    let [last, owed, frames] = [begun, 0, 0];
    return new Promise((resolve, reject) => {
      const frame = (now) => {
        owed += (this.speed * Math.min((now - last) / 1000, LONGEST_FRAME)) / timestep;
        last = now;
        for (; owed >= 1 && !mover.done; owed--) mover.step();
        this.page.draw(this.world, this.scene.inPlay);
        frames += 1;
        if (!mover.done) return request();
        const rate = (1000 * frames) / (performance.now() - begun);
        this.times.frames.push(rate);
        if (this.speed <= 1) this.page.adapt(rate);
        resolve();
      };
      const request = () =>
        requestAnimationFrame((now) => {
          try {
            frame(now);
          } catch (error) {
            reject(error);
          }
        });
      request();
    });
  }

  /** Performs an action, by default the decision: {outcome, lifted, lost}, or null without one. */
  async act(action = this.decision) {
    if (!action) return null;
    const { robot, view } = this.content;
    const { obs, scene } = this;
    const planned = plan(robot, view, obs.height, action);
    await this.animate(new Travel(this.world, planned.start));
    const motion = new Motion(this.world, scene, planned, action.primitive);
    await this.animate(motion);
    const result = motion.result();
    await this.animate(new Travel(this.world, this.hand, result.lifted));
    this.actions += 1;
    this.place((this.scene = result.scene));
    const next = observe(view, this.world.parts(this.number, result.scene));
    const changed = movedArea(view, obs.height, next.height) > this.content.judge.change;
    this.avoided = changed ? [] : [...this.avoided, action];
    await this.decide();
    this.page.report(this, describe(action, result));
    return result;
  }

  /** Acts until the table is clear, nothing can be done, or `running` is false. */
  async clear() {
    this.running = true;
    for (let i = 0; i < MOST_ACTIONS && this.running && this.decision; i++) await this.act();
    this.running = false;
  }

  /** Drops the blocks of the scene anew; `random` returns numbers in [0, 1). */
  async drop(random = Math.random) {
    const scene = this.world.empty();
    this.start.inPlay.forEach((is, slot) => is && this.throwIn(scene, slot, random));
    await this.fall(scene);
  }

  /** Puts a block into the air, above those that are there. */
  throwIn(scene, slot, random) {
    const above = scene.inPlay.filter(Boolean).length;
    const [x, y] = [random(), random()].map((share) => (share - 0.5) * DROP.side);
    const turn = Array.from({ length: 4 }, () => random() + random() + random() - 1.5);
    const length = Math.hypot(...turn) || 1;
    const z = DROP.height + DROP.spacing * above;
    scene.pose.set([x, y, z, ...turn.map((value) => value / length)], 7 * slot);
    scene.inPlay[slot] = true;
  }

  /** Lets a scene fall, and decides about it. */
  async fall(scene) {
    await this.deciding;
    this.scene = scene;
    const fall = new Fall(this.world, scene, SETTLE);
    const { speed } = this;
    this.speed = Math.max(speed, 1);
    await this.animate(fall).finally(() => (this.speed = speed));
    await this.restart(fall.result().scene);
  }

  /** Holds a block at [x, y, z] m; its maps follow as soon as the last ones are there. */
  drag(slot, place) {
    this.scene.pose.set(place, 7 * slot);
    this.place(this.scene);
    this.deciding ??= this.decide().finally(() => (this.deciding = null));
  }

  /** Drops a mesh, the text of an OBJ file, onto the scene as a convex body. */
  async addMesh(text, random = Math.random) {
    const own = fromObj(text);
    const before = this.scene;
    const world = new World(this.engine, this.content, own);
    own.faces = hullFaces(world.model, rotation);
    this.world.delete();
    this.world = world;
    this.start = world.load(this.number);
    this.start.inPlay[world.blocks] = true;
    const scene = world.empty();
    before.inPlay.slice(0, world.blocks).forEach((is, slot) => (scene.inPlay[slot] = is));
    scene.pose.set(before.pose.subarray(0, 7 * world.blocks));
    this.page.build(world);
    this.throwIn(world.park(scene), world.blocks, random);
    await this.fall(scene);
    return own;
  }
}

/** Returns the area, cm^2, whose height changed by 1 cm to 30 cm. */
function movedArea({ size, extent }, before, after) {
  const changes = after.map((value, cell) => Math.abs(value - before[cell]));
  const cells = changes.filter((change) => change >= 0.01 && change <= 0.3).length;
  return cells * (100 * (extent / size)) ** 2;
}

function describe({ primitive, pose: [x, y, yaw], score }, { outcome, lifted, lost }) {
  const place = `(${Math.round(1000 * x)}, ${Math.round(1000 * y)}) mm`;
  const turn = `${Math.round((180 * yaw) / Math.PI)}°`;
  const name = primitive === PUSH ? "Push" : "Grasp";
  const value = score === undefined ? "" : `, Q ${score.toFixed(2)}`;
  const effects = [primitive === GRASP ? NAMES[outcome] : "done"];
  if (lifted.length > 1) effects.push(`${lifted.length} blocks`);
  if (lost.length) effects.push("a block lost");
  return `${name} at ${place}, ${turn}${value}: ${effects.join(", ")}`;
}
