// The page: its elements, and what they do.

import loadMujoco from "@mujoco/mujoco";
import content from "built:world";
import mujocoFile from "packed:mujoco";
import runtimeFile from "packed:onnxruntime";
import policyFile from "packed:policy";
import { Demo } from "./demo.js";
import { Picture, onLevel } from "./draw.js";
import { drawAction, drawQ, drawView } from "./maps.js";
import { load } from "./policy.js";
import { GRASP, PUSH } from "./primitives.js";

const HELD = 0.16; // m, height of a block that is dragged
const ELEMENTS = `
  <div class="demo-controls">
    <button class="md-button md-button--primary" data-is="clear">Clear the table</button>
    <button class="md-button" data-is="act">One action</button>
    <button class="md-button" data-is="drop">Drop anew</button>
    <label class="md-button">Add a mesh<input type="file" accept=".obj" data-is="mesh"></label>
    <label>Scene <select data-is="scenes"></select></label>
  </div>
  <div class="demo-scene"><canvas data-is="scene" aria-label="The scene"></canvas></div>
  <div class="demo-maps">
    <figure><canvas data-is="view"></canvas><figcaption>Seen from above</figcaption></figure>
    <figure><canvas data-is="push"></canvas><figcaption data-is="pushed"></figcaption></figure>
    <figure><canvas data-is="grasp"></canvas><figcaption data-is="grasped"></figcaption></figure>
  </div>
  <p class="demo-status" role="status" data-is="status"></p>
  <p class="demo-numbers" data-is="numbers"></p>`;

/** Unpacks a file that the bundle holds. */
async function unpack(text) {
  const { body } = await fetch(`data:application/gzip;base64,${text}`);
  const stream = body.pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** What a visitor sees; a Demo calls it. */
class Page {
  constructor(root) {
    root.innerHTML = ELEMENTS;
    this.parts = {};
    root.querySelectorAll("[data-is]").forEach((part) => (this.parts[part.dataset.is] = part));
    this.picture = new Picture(this.parts.scene, content.view);
    this.paint();
    const watch = new MutationObserver(() => this.paint());
    watch.observe(document.body, { attributeFilter: ["data-md-color-scheme"] });
    this.picture.controls.addEventListener("change", () => this.redraw());
    new ResizeObserver(() => this.redraw()).observe(this.parts.scene);
  }

  paint() {
    const isDark = document.body.getAttribute("data-md-color-scheme") === "slate";
    this.picture.paint(isDark ? "dark" : "light");
    this.redraw();
  }

  build(world) {
    this.picture.build(world);
  }

  draw(world, shown) {
    this.drawn = [world, shown];
    this.picture.draw(world, shown);
  }

  adapt(frames) {
    this.picture.adapt(frames);
  }

  redraw() {
    if (this.drawn && this.drawn[0].data) this.picture.draw(...this.drawn);
  }

  showMaps(obs, q, decision) {
    const { view, robot } = content;
    const valid = q.flatMap((values) => Array.from(values.filter(Number.isFinite)));
    const range = [Math.min, Math.max].map((end) => valid.reduce((a, b) => end(a, b), 0));
    drawView(this.parts.view, view, obs);
    for (const [primitive, name] of [[PUSH, "push"], [GRASP, "grasp"]]) {
      drawQ(this.parts[name], view, q[primitive], range);
      const best = q[primitive].reduce((a, b) => Math.max(a, b), -Infinity);
      const title = name === "push" ? "Push value" : "Grasp value";
      const text = Number.isFinite(best) ? `best ${best.toFixed(2)}` : "nowhere";
      this.parts[`${name}ed`].textContent = `${title}, ${text}`;
    }
    if (!decision) return;
    const chosen = this.parts[decision.primitive === PUSH ? "push" : "grasp"];
    for (const canvas of [this.parts.view, chosen]) drawAction(canvas, view, robot, decision);
  }

  report({ scene, times, actions }, text) {
    const left = scene.inPlay.filter(Boolean).length;
    this.parts.status.textContent = text;
    const numbers = [`${left} left after ${actions} actions`];
    numbers.push(`decision ${Math.round(times.decisions.at(-1))} ms`);
    if (times.frames.length) numbers.push(`${Math.round(times.frames.at(-1))} frames/s`);
    this.parts.numbers.textContent = numbers.join(", ");
  }

  say(text) {
    this.parts.status.textContent = text;
  }
}

/** Connects buttons, pointer and files to a demonstration. One thing happens at a time. */
function connect(demo, page) {
  const { parts, picture } = page;
  const others = [parts.act, parts.drop, parts.mesh, parts.scenes];
  let isBusy = false;

  const alone = async (work) => {
    if (isBusy) return;
    isBusy = true;
    others.forEach((part) => (part.disabled = true));
    try {
      await work();
    } catch (error) {
      page.say(`This failed: ${error.message}`);
    } finally {
      isBusy = false;
      others.forEach((part) => (part.disabled = false));
    }
  };
  const fallen = async (work) => {
    page.say("Falling");
    await work();
    page.report(demo, "At rest. Drag a block, or let the policy act.");
  };

  parts.clear.onclick = () => {
    if (demo.running) return (demo.running = false);
    alone(async () => {
      parts.clear.textContent = "Pause";
      await demo.clear().finally(() => (parts.clear.textContent = "Clear the table"));
      if (!demo.scene.inPlay.some(Boolean)) page.say("The table is clear.");
    });
  };
  parts.act.onclick = () => alone(() => demo.act());
  parts.drop.onclick = () => alone(() => fallen(() => demo.drop()));
  parts.scenes.onchange = () => alone(() => start(demo, page, Number(parts.scenes.value)));

  const add = (file) => alone(() => fallen(async () => demo.addMesh(await file.text())));
  parts.mesh.onchange = () => {
    if (parts.mesh.files.length) add(parts.mesh.files[0]);
    parts.mesh.value = "";
  };
  parts.scene.ondragover = (event) => event.preventDefault();
  parts.scene.ondrop = (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) add(event.dataTransfer.files[0]);
  };

  let held = -1;
  parts.scene.addEventListener("pointerdown", (event) => {
    const { slot } = picture.pick(event);
    if (isBusy || slot < 0) return;
    [held, picture.controls.enabled] = [slot, false];
    parts.scene.setPointerCapture(event.pointerId);
  }, { capture: true });
  parts.scene.addEventListener("pointermove", (event) => {
    const { slot, ray } = picture.pick(event);
    if (held < 0) return (parts.scene.style.cursor = slot >= 0 && !isBusy ? "grab" : "");
    const place = onLevel(ray, HELD);
    if (place && place.every((value) => Math.abs(value) < 0.2)) demo.drag(held, [...place, HELD]);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    parts.scene.addEventListener(name, () => {
      if (held < 0) return;
      [held, picture.controls.enabled] = [-1, true];
      alone(() => fallen(() => demo.fall(demo.scene)));
    });
  }
}

/** Starts with a scene; its blocks alone, without an own mesh. */
async function start(demo, page, number) {
  await demo.load(number);
  page.report(demo, "Drag a block, or let the policy act.");
}

function listScenes(select) {
  const seen = {};
  content.scenes.forEach(({ inPlay }, number) => {
    const blocks = inPlay.filter(Boolean).length;
    seen[blocks] = (seen[blocks] ?? 0) + 1;
    select.add(new Option(`${blocks} blocks, no. ${seen[blocks]}`, number));
  });
}

async function main(root) {
  root.textContent = "Unpacking MuJoCo, onnxruntime and the policy";
  try {
    const files = [mujocoFile, runtimeFile, policyFile];
    const [mujoco, runtime, policy] = await Promise.all(files.map(unpack));
    const engine = await loadMujoco({ wasmBinary: mujoco });
    const session = await load(runtime, policy);
    const page = new Page(root);
    const demo = new Demo(engine, session, content, page);
    listScenes(page.parts.scenes);
    await start(demo, page, 0);
    connect(demo, page);
    window.csac = demo;
  } catch (error) {
    root.textContent = `This browser cannot run the page: ${error.message}`;
    throw error;
  }
}

main(document.getElementById("demo"));
