// Drives the page "In the browser" in Chromium, without a network, and writes what it measured.
//
//     node tests/browser.mjs JOB.json
//
// A job has: modules, a folder with playwright-core; chromium; page, a file; grasps, a pose by
// scene; mesh, an OBJ file; results, the file to write.

import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const job = JSON.parse(readFileSync(process.argv[2], "utf8"));
const { chromium } = createRequire(`${job.modules}/package.json`)("playwright-core");
const FAST = 1e6; // times real time: a primitive takes one frame
const MINUTE = 60_000; // ms

const browser = await chromium.launch({ executablePath: job.chromium, args: ["--no-sandbox"] });
try {
  const context = await browser.newContext({ viewport: { width: 1300, height: 1000 } });
  await context.setOffline(true);
  const page = await context.newPage();
  const faults = [];
  page.on("console", (message) => message.type() === "error" && faults.push(message.text()));
  page.on("pageerror", (error) => faults.push(error.message));
  page.on("request", (request) => request.url().startsWith("http") && faults.push(request.url()));
  await page.goto(pathToFileURL(job.page).href);
  await page.waitForFunction("window.csac", null, { timeout: MINUTE });
  const seen = await page.evaluate(see, job.grasps.length);
  const grasps = await page.evaluate(grasp, [job.grasps, FAST]);
  const clearing = await clear(page);
  const dropped = await page.evaluate(dropAndClear, FAST);
  const mesh = await addMesh(page);
  const found = await search(page);
  writeFileSync(
    job.results,
    JSON.stringify({ seen, grasps, clearing, dropped, mesh, found, faults }),
  );
} finally {
  await browser.close();
}

/** Returns the view and the decision of each scene. */
async function see(number) {
  const seen = [];
  for (let scene = 0; scene < number; scene++) {
    await csac.load(scene);
    const { obs, decision, maps } = csac;
    seen.push({ height: Array.from(obs.height), decision, exported: maps.choice });
  }
  return seen;
}

/** Grasps in each scene: the outcome, and the blocks that are left. */
async function grasp([poses, speed]) {
  const results = [];
  csac.speed = speed;
  for (const [scene, pose] of poses.entries()) {
    await csac.load(scene);
    const { outcome } = await csac.act({ primitive: 1, pose });
    results.push({ outcome, left: csac.scene.inPlay });
  }
  return results;
}

/** Clears the first scene by the button, as a visitor sees it. */
async function clear(page) {
  await page.evaluate(async () => {
    await csac.load(0);
    csac.speed = 0.5;
    csac.times = { decisions: [], frames: [] };
  });
  const before = await page.evaluate(() => csac.scene.inPlay.filter(Boolean).length);
  await page.click("[data-is=clear]");
  await page.waitForFunction(
    () => document.querySelector("[data-is=status]").textContent === "The table is clear.",
    null,
    { timeout: MINUTE },
  );
  return { before, ...(await page.evaluate(() => csac.times)) };
}

/** Drops the first scene's blocks by a seed and clears them: the blocks before and after. */
async function dropAndClear(speed) {
  let seed = 7;
  const random = () => (seed = (16807 * seed) % 2147483647) / 2147483647; // Park and Miller
  await csac.load(0);
  csac.speed = speed;
  await csac.drop(random);
  const before = csac.scene.inPlay.filter(Boolean).length;
  await csac.clear();
  return { before, after: csac.scene.inPlay.filter(Boolean).length };
}

/** Adds a mesh by the file button, far from the blocks: where it is at rest, in the view, too. */
async function addMesh(page) {
  await page.evaluate(async () => {
    await csac.load(0);
    csac.scene.inPlay.fill(false);
    await csac.show(csac.world.park(csac.scene));
  });
  await page.setInputFiles("[data-is=mesh]", job.mesh);
  await page.waitForFunction(
    () => csac.world.own && /^At rest/.test(document.querySelector("[data-is=status]").textContent),
    null,
    { timeout: MINUTE },
  );
  return page.evaluate(() => {
    const place = csac.scene.pose.subarray(7 * csac.world.blocks);
    const { size, extent } = csac.content.view;
    const [col, row] = [0, 1].map((axis) => Math.floor((place[axis] / extent + 0.5) * size));
    const height = csac.obs.height[row * size + col];
    return { height, centre: place[2], inPlay: csac.scene.inPlay.at(-1) };
  });
}

/** Searches the site for a word; returns the pages that it lists. */
async function search(page) {
  await page.click("[name=query]");
  await page.keyboard.type("pinwheel");
  await page.waitForSelector(".md-search-result__link", { state: "attached" });
  return page.$$eval(".md-search-result__link", (links) => links.map((link) => link.href));
}
