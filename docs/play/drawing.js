// Draws a MuJoCo model with three.js: one mesh for each visible geom, placed with its body.
import * as three from 'three';
import { OrbitControls } from './lib/OrbitControls.js';

const HIDDEN_GROUP = 3; // collision shapes and invisible planes
const SKY = 0xdfe6ee;
const PANEL = 360; // width of the page's panel, pixels
const BEYOND = 0.04; // m beside the track, up to the outer face of its walls

/** Geometry of a geom by MuJoCo's type number, or null where it is not drawn. */
function shape(type, [a, b, c]) {
  const upright = (geometry) => geometry.rotateX(Math.PI / 2); // three's axis is y, MuJoCo's z
  if (type === 0) return new three.PlaneGeometry(2 * (a || 20), 2 * (b || 20));
  if (type === 2) return new three.SphereGeometry(a, 24, 16);
  if (type === 3) return upright(new three.CapsuleGeometry(a, 2 * b, 8, 20));
  if (type === 4) return new three.SphereGeometry(1, 24, 16).scale(a, b, c);
  if (type === 5) return upright(new three.CylinderGeometry(a, a, 2 * b, 28));
  if (type === 6) return new three.BoxGeometry(2 * a, 2 * b, 2 * c);
  return null;
}

const part = (values, index, size) => values.slice(size * index, size * (index + 1));
const quaternion = ([w, x, y, z]) => new three.Quaternion(x, y, z, w);

export class Drawing {
  /** @param canvas to draw on. @param model of MuJoCo. @param settings of the scene. */
  constructor(canvas, model, settings) {
    this.renderer = new three.WebGLRenderer({ canvas, antialias: true });
    this.renderer.localClippingEnabled = true;
    // Movable walls reach beyond the track for some positions of the gap: what is outside is not drawn.
    const edge = settings.params.track_width / 2 + BEYOND;
    this.track = [1, -1].map((side) => new three.Plane(new three.Vector3(0, side, 0), edge));
    this.renderer.shadowMap.enabled = true;
    this.scene = new three.Scene();
    this.scene.background = new three.Color(SKY);
    this.camera = new three.PerspectiveCamera(40, 1, 0.05, 100);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-1.7, -5.5, 4.6);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.target.set(3, 0, 0);
    this.controls.update();
    this.addLight();
    this.bodies = Array.from({ length: model.nbody }, () => new three.Group());
    this.scene.add(...this.bodies);
    for (let geom = 0; geom < model.ngeom; geom++) this.addGeom(model, geom);
  }

  addLight() {
    this.scene.add(new three.HemisphereLight(0xffffff, 0x8d8d96, 1.6));
    const sun = new three.DirectionalLight(0xffffff, 2.2);
    sun.position.set(1, -3, 7);
    sun.target.position.set(3, 0, 0);
    sun.castShadow = true;
    sun.shadow.mapSize.set(2048, 2048);
    Object.assign(sun.shadow.camera, { left: -5, right: 5, bottom: -5, top: 5, near: 1, far: 20 });
    this.scene.add(sun, sun.target);
  }

  addGeom(model, geom) {
    if (model.geom_group[geom] === HIDDEN_GROUP) return;
    const type = model.geom_type[geom];
    const geometry = shape(type, part(model.geom_size, geom, 3));
    if (geometry === null) return;
    const [r, g, b, alpha] = part(model.geom_rgba, geom, 4);
    const color = new three.Color().setRGB(r, g, b, three.SRGBColorSpace);
    const material = new three.MeshStandardMaterial({ color, opacity: alpha, transparent: alpha < 1, roughness: 0.7 });
    const body = model.geom_bodyid[geom];
    if (model.body_mocapid[body] >= 0) Object.assign(material, { clippingPlanes: this.track, clipShadows: true });
    const mesh = new three.Mesh(geometry, material);
    mesh.position.set(...part(model.geom_pos, geom, 3));
    mesh.quaternion.copy(quaternion(part(model.geom_quat, geom, 4)));
    mesh.castShadow = type !== 0;
    mesh.receiveShadow = true;
    this.bodies[body].add(mesh);
  }

  /** Draws the bodies where `data` has them, on a canvas of the size that the page gives it. */
  draw(data) {
    const { xpos, xquat } = data;
    this.bodies.forEach((group, body) => {
      group.position.set(...part(xpos, body, 3));
      group.quaternion.copy(quaternion(part(xquat, body, 4)));
    });
    const canvas = this.renderer.domElement;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width !== this.width || height !== this.height) {
      Object.assign(this, { width, height });
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / height;
      const aside = width > 2.5 * PANEL ? PANEL / 2 : 0;
      this.camera.setViewOffset(width, height, -aside, 0, width, height); // updates the projection
    }
    this.renderer.render(this.scene, this.camera);
  }
}
