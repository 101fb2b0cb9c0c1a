// Bundles the page's script, with engines, world and policy in it: it opens from the file system.
//
//     node docs/browser/build.mjs build/browser
//
// The folder has node_modules, and what export.py writes.

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

const here = dirname(fileURLToPath(import.meta.url));
const folder = resolve(process.argv[2]);
const { build } = createRequire(join(folder, "package.json"))("esbuild");
const modules = join(folder, "node_modules");
const packed = {
  "packed:mujoco": join(modules, "@mujoco/mujoco/mujoco.wasm"),
  "packed:onnxruntime": join(modules, "onnxruntime-web/dist/ort-wasm-simd-threaded.wasm"),
  "packed:policy": join(folder, "policy.onnx"),
};

/** Makes `packed:NAME` a string: the file, by gzip and base64. */
const pack = {
  name: "pack",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^packed:/ }, ({ path }) => ({ path: packed[path], namespace: "packed" }));
    onLoad({ filter: /.*/, namespace: "packed" }, async ({ path }) => {
      const content = gzipSync(await readFile(path), { level: 9 });
      return { contents: content.toString("base64"), loader: "text" };
    });
  },
};

await build({
  entryPoints: [join(here, "src/main.js")],
  outfile: join(folder, "app.js"),
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  nodePaths: [modules],
  alias: { "built:world": join(folder, "world.json") },
  external: ["module"], // which MuJoCo imports in node only
  define: { "import.meta.url": "document.baseURI" },
  plugins: [pack],
  logLevel: "warning",
});
