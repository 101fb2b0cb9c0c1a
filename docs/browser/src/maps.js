// Maps of the workspace on canvases: Q by primitive and heights, with the action drawn in.

import { PUSH } from "./primitives.js";

const VIRIDIS = "440154 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725".split(" ");
const STOPS = VIRIDIS.map((hex) => [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16)));
const TALLEST = 0.12; // m, the end of the height map's scale
const CHOSEN = "#d55e00"; // palette of Okabe and Ito
const PIXELS = 384; // side of a canvas

/** Draws Q [H * W] in colours from `low` to `high`; cells of -Infinity stay clear. */
export function drawQ(canvas, view, q, [low, high]) {
  drawCells(canvas, view, q, (value) => {
    if (value === -Infinity) return [128, 128, 128, 30];
    return [...viridis((value - low) / Math.max(high - low, 1e-6)), 255];
  });
}

/** Draws the colours [H * W * 3] of a view; what has a height [H * W] m is lighter. */
export function drawView(canvas, view, { height, colour }) {
  drawCells(canvas, view, height, (value, cell) => {
    const gain = value > 0 ? 1 + 0.45 * Math.min(value / TALLEST, 1) : 1;
    const levels = colour.subarray(3 * cell, 3 * cell + 3).map((level) => 255 * level * gain);
    return [...levels, 255];
  });
}

function viridis(share) {
  const at = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
  const left = Math.min(Math.floor(at), STOPS.length - 2);
  return STOPS[left].map((value, i) => value + (at - left) * (STOPS[left + 1][i] - value));
}

/** Draws one coloured square for each cell; row 0 is at the bottom. */
function drawCells(canvas, { size }, values, rgba) {
  const small = new OffscreenCanvas(size, size);
  const image = new ImageData(size, size);
  values.forEach((value, cell) => {
    const row = size - 1 - Math.floor(cell / size);
    image.data.set(rgba(value, cell), 4 * (row * size + (cell % size)));
  });
  small.getContext("2d").putImageData(image, 0, 0);
  canvas.width = canvas.height = PIXELS;
  const context = canvas.getContext("2d");
  context.imageSmoothingEnabled = false;
  context.drawImage(small, 0, 0, PIXELS, PIXELS);
}

/** Draws a push as an arrow, a grasp as fingers and the line they close along. */
export function drawAction(canvas, view, robot, { primitive, pose: [x, y, yaw] }) {
  const context = canvas.getContext("2d");
  context.save();
  context.translate(0.5 * PIXELS, 0.5 * PIXELS);
  context.scale(PIXELS / view.extent, -PIXELS / view.extent);
  context.translate(x, y);
  context.rotate(yaw);
  const path = primitive === PUSH ? arrow(robot) : fingers(robot);
  for (const [colour, width] of [["white", 0.009], [CHOSEN, 0.005]]) {
    Object.assign(context, { strokeStyle: colour, lineWidth: width, lineCap: "round" });
    context.stroke(path);
  }
  context.restore();
}

function arrow({ pushLength }) {
  return new Path2D(`M0 0H${pushLength}m-0.02 -0.015l0.02 0.015l-0.02 0.015`);
}

function fingers({ half, fingerWidth }) {
  const open = half[1];
  const tip = (x) => `M${x} ${-0.5 * fingerWidth}V${0.5 * fingerWidth}`;
  return new Path2D(`M${-open} 0H${open}${tip(-open)}${tip(open)}`);
}
