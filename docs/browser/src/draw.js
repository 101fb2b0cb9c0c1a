// The scene in three.js: every geom of MuJoCo's model where it is.

import * as three from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const [PLANE, BOX, MESH] = [0, 6, 7]; // of mjtGeom
const SUN = new three.Vector3(0.36, 0.48, 0.8); // the light of the policy's view
const THEMES = {
  light: { sky: 0xf4f4f2, ground: 0xdcdad5, border: 0x8a8782, shadow: 0xb4b1ab },
  dark: { sky: 0x22252e, ground: 0x363944, border: 0x8088a0, shadow: 0x23252d },
};
const SLOW = 30; // frames/s, below which the picture gets coarser
const COARSEST = 0.4; // pixels of the picture for one of the page, along a side

// Moves points along the sun's rays onto the table; a thousandth of a height keeps faces apart.
const ONTO_TABLE = new three.Matrix4().set(
  ...[1, 0, -SUN.x / SUN.z, 0],
  ...[0, 1, -SUN.y / SUN.z, 0],
  ...[0, 0, 0.001, -0.001],
  ...[0, 0, 0, 1],
);

/** A picture of a world. */
export class Picture {
  constructor(canvas, view) {
    this.renderer = new three.WebGLRenderer({ canvas, antialias: true });
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(36, 1, 0.05, 10);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(0.1, -0.72, 0.6);
    this.controls = new OrbitControls(this.camera, canvas);
    const limits = { enablePan: false, minDistance: 0.5, maxDistance: 2, maxPolarAngle: 1.45 };
    Object.assign(this.controls, limits);
    this.controls.target.set(0, 0, 0.06);
    this.controls.update();
    this.light();
    this.table(view);
    this.geoms = new three.Group();
    this.shadows = new three.Group();
    this.shadow = new three.MeshBasicMaterial();
    this.scene.add(this.geoms, this.shadows);
    this.ratio = Math.min(window.devicePixelRatio, 2);
  }

  light() {
    const sun = new three.DirectionalLight(0xffffff, 1.7);
    sun.position.copy(SUN);
    this.scene.add(sun, new three.HemisphereLight(0xffffff, 0xc8c0b8, 2));
  }

  table({ extent }) {
    this.ground = new three.Mesh(
      new three.CircleGeometry(0.62, 64),
      new three.MeshBasicMaterial(),
    );
    this.ground.position.z = -0.002;
    const half = 0.5 * extent;
    const corners = [[-half, -half], [half, -half], [half, half], [-half, half]];
    const points = corners.map(([x, y]) => new three.Vector3(x, y, 0.0002));
    this.border = new three.LineLoop(
      new three.BufferGeometry().setFromPoints(points),
      new three.LineBasicMaterial(),
    );
    this.scene.add(this.ground, this.border);
  }

  /** Takes the colours of the page's theme, `light` or `dark`. */
  paint(theme) {
    const { sky, ...others } = THEMES[theme];
    this.scene.background = new three.Color(sky);
    this.ground.material.color.set(others.ground);
    this.border.material.color.set(others.border);
    this.shadow.color.set(others.shadow);
  }

  /** Makes the geoms of a world, whose blocks have changed. */
  build(world) {
    const { model, content } = world;
    this.geoms.children.forEach((mesh) => mesh.geometry.dispose());
    this.geoms.clear();
    this.shadows.clear();
    for (let geom = 0; geom < model.ngeom; geom++) {
      if (model.geom_type[geom] === PLANE) continue;
      const slot = content.addresses.slotOfGeom[geom] ?? world.blocks;
      const mesh = new three.Mesh(shape(model, geom), material(world, geom, slot));
      mesh.matrixAutoUpdate = false;
      mesh.userData = { geom, slot, shadow: new three.Mesh(mesh.geometry, this.shadow) };
      mesh.userData.shadow.matrixAutoUpdate = false;
      this.geoms.add(mesh);
      this.shadows.add(mesh.userData.shadow);
    }
  }

  /** Draws the world as it is; slots that are not `shown` are hidden. */
  draw(world, shown) {
    const { geom_xpos: place, geom_xmat: turn } = world.data;
    for (const mesh of this.geoms.children) {
      const { geom, slot, shadow } = mesh.userData;
      const [p, m] = [3 * geom, 9 * geom];
      mesh.visible = slot < 0 || shown[slot];
      mesh.matrix.set(
        ...[turn[m], turn[m + 1], turn[m + 2], place[p]],
        ...[turn[m + 3], turn[m + 4], turn[m + 5], place[p + 1]],
        ...[turn[m + 6], turn[m + 7], turn[m + 8], place[p + 2]],
        ...[0, 0, 0, 1],
      );
      shadow.visible = mesh.visible && place[p + 2] > 0;
      shadow.matrix.multiplyMatrices(ONTO_TABLE, mesh.matrix);
    }
    this.fit();
    this.renderer.render(this.scene, this.camera);
  }

  /** Fits the picture's pixels to the size of its canvas on the page. */
  fit() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    const size = this.renderer.getSize(new three.Vector2());
    const isSame = size.x === width && size.y === height;
    if (!width || (isSame && this.renderer.getPixelRatio() === this.ratio)) return;
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.zoom = Math.min(1, this.camera.aspect / 1.25); // narrow pictures show it all
    this.camera.updateProjectionMatrix();
  }

  /** Draws coarser from now on, where there were fewer frames/s than SLOW. */
  adapt(frames) {
    if (frames < SLOW) this.ratio = Math.max(0.7 * this.ratio, COARSEST);
  }

  /** Returns the slot of the block under a pointer, or -1, and the pointer's ray. */
  pick({ clientX, clientY }) {
    const box = this.renderer.domElement.getBoundingClientRect();
    const x = (2 * (clientX - box.left)) / box.width - 1;
    const y = 1 - (2 * (clientY - box.top)) / box.height;
    const caster = new three.Raycaster();
    caster.setFromCamera(new three.Vector2(x, y), this.camera);
    const visible = this.geoms.children.filter((mesh) => mesh.visible);
    const hits = caster.intersectObjects(visible);
    return { slot: hits.length ? hits[0].object.userData.slot : -1, ray: caster.ray };
  }
}

/** Returns where a ray meets the level at `z` m, [x, y], or null. */
export function onLevel(ray, z) {
  const plane = new three.Plane(new three.Vector3(0, 0, 1), -z);
  const point = ray.intersectPlane(plane, new three.Vector3());
  return point && [point.x, point.y];
}

function shape(model, geom) {
  const size = Array.from(model.geom_size.subarray(3 * geom, 3 * geom + 3), (half) => 2 * half);
  const kind = model.geom_type[geom];
  if (kind === BOX) return new three.BoxGeometry(...size);
  if (kind === MESH) return meshShape(model, model.geom_dataid[geom]);
  throw new Error(`geom ${geom}: draw.js has no shape of MuJoCo's type ${kind}`);
}

function meshShape(model, mesh) {
  const [first, start] = [model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]];
  const faces = model.mesh_face.subarray(3 * start, 3 * (start + model.mesh_facenum[mesh]));
  const corners = Array.from(faces, (i) => {
    const at = 3 * (first + i);
    return Array.from(model.mesh_vert.subarray(at, at + 3));
  });
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.Float32BufferAttribute(corners.flat(), 3));
  geometry.computeVertexNormals();
  return geometry;
}

function material(world, geom, slot) {
  const { view } = world.content;
  const rgba = Array.from(world.model.geom_rgba.subarray(4 * geom, 4 * geom + 3));
  const own = slot === world.blocks ? world.own?.colour : view.colours[world.colours[slot]];
  const [r, g, b] = slot < 0 ? rgba : own;
  const colour = new three.Color().setRGB(r, g, b, three.SRGBColorSpace);
  return new three.MeshLambertMaterial({ color: colour });
}
