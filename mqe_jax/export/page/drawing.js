// Draws a MuJoCo model with three.js: the visible geoms of a body are one mesh, coloured by vertex.
import * as three from 'three';
import { Camera } from './camera.js';
import { mergeGeometries } from './lib/BufferGeometryUtils.js';

const HIDDEN_GROUP = 3; // collision shapes and invisible planes
const SKY = 0xcfe0ee;
const BEYOND = 0.04; // m beside the track, up to the outer face of its walls

/** Geometry of a geom by MuJoCo's type number, or null where it is not drawn; finer with more `detail`. */
function shape(type, [a, b, c], detail) {
  const upright = (geometry) => geometry.rotateX(Math.PI / 2); // three's axis is y, MuJoCo's z
  if (type === 0) return new three.PlaneGeometry(2 * (a || 20), 2 * (b || 20));
  if (type === 2) return new three.SphereGeometry(a, 10 * detail, 7 * detail);
  if (type === 3) return upright(new three.CapsuleGeometry(a, 2 * b, 3 * detail, 8 * detail));
  if (type === 4) return new three.SphereGeometry(1, 10 * detail, 7 * detail).scale(a, b, c);
  if (type === 5) return upright(new three.CylinderGeometry(a, a, 2 * b, a > 0.3 ? 48 : 12 * detail));
  if (type === 6) return new three.BoxGeometry(2 * a, 2 * b, 2 * c);
  return null;
}

/** Geometry of a mesh geom. */
function mesh(model, id) {
  const [vertex, face] = [model.mesh_vertadr[id], model.mesh_faceadr[id]];
  const geometry = new three.BufferGeometry();
  const points = model.mesh_vert.slice(3 * vertex, 3 * (vertex + model.mesh_vertnum[id]));
  geometry.setAttribute('position', new three.BufferAttribute(Float32Array.from(points), 3));
  geometry.setIndex([...model.mesh_face.slice(3 * face, 3 * (face + model.mesh_facenum[id]))]);
  geometry.computeVertexNormals();
  return geometry.setAttribute('uv', new three.BufferAttribute(new Float32Array((2 * points.length) / 3), 2));
}

/** A material for slow machines: lit by vertex, in the colours as they are, so that a pixel costs next to nothing. */
function cheap(options) {
  const { opacity, ...rest } = options;
  return new three.ShaderMaterial({
    ...rest,
    clipping: true,
    uniforms: { opacity: { value: opacity }, sun: { value: new three.Vector3(-0.2, -0.4, 0.9) } },
    vertexShader: `
      #include <clipping_planes_pars_vertex>
      uniform vec3 sun;
      varying vec3 shade;
      void main() {
        vec3 up = normalize(mat3(modelMatrix) * normal);
        shade = color * (0.72 + 0.28 * dot(up, sun));
        vec4 mvPosition = modelViewMatrix * vec4(position, 1.0);
        gl_Position = projectionMatrix * mvPosition;
        #include <clipping_planes_vertex>
      }`,
    fragmentShader: `
      #include <clipping_planes_pars_fragment>
      uniform float opacity;
      varying vec3 shade;
      void main() {
        #include <clipping_planes_fragment>
        gl_FragColor = vec4(shade, opacity);
      }`,
  });
}

const part = (values, index, size) => values.slice(size * index, size * (index + 1));
const quaternion = ([w, x, y, z]) => new three.Quaternion(x, y, z, w);

/** Whether the browser draws without a GPU. */
export function drawsInSoftware() {
  const context = document.createElement('canvas').getContext('webgl2');
  const info = context?.getExtension('WEBGL_debug_renderer_info');
  return /swiftshader|llvmpipe|software/i.test(info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : '');
}

export class Drawing {
  /** @param canvas to draw on. @param low whether to draw with less detail, for machines without a fast GPU. */
  constructor(canvas, low) {
    this.low = low;
    this.renderer = new three.WebGLRenderer({ canvas, antialias: !low, powerPreference: 'high-performance' });
    this.renderer.setPixelRatio(low ? 1 : Math.min(window.devicePixelRatio, 2));
    this.renderer.localClippingEnabled = true;
    this.renderer.shadowMap.enabled = !low;
    this.camera = new Camera(canvas);
  }

  /** Shows a model; `settings` are those of `scene.json`. */
  show(model, settings) {
    this.settings = settings;
    this.scene?.traverse((item) => item.geometry?.dispose());
    this.scene = new three.Scene();
    this.scene.background = new three.Color(SKY);
    this.bodies = Array.from({ length: model.nbody }, () => new three.Group());
    this.scene.add(...this.bodies);
    // Movable walls reach beyond the track for some positions of the gap: what is outside is not drawn.
    const edge = settings.track.width / 2 + BEYOND;
    this.track = [1, -1].map((side) => new three.Plane(new three.Vector3(0, side, 0), edge));
    this.addLight();
    this.addGeoms(model);
    this.camera.show(model, this.boxes, settings);
  }

  addLight() {
    const { start, length, width } = this.settings.track;
    const middle = start + length / 2;
    this.scene.add(new three.HemisphereLight(0xffffff, 0x9a9a92, 1.5));
    const sun = new three.DirectionalLight(0xffffff, 1.7);
    sun.position.set(middle - 2, -4, 9);
    sun.target.position.set(middle, 0, 0);
    sun.castShadow = !this.low;
    sun.shadow.mapSize.set(2048, 2048);
    const reach = Math.hypot(length, width) / 2 + 1;
    Object.assign(sun.shadow.camera, { left: -reach, right: reach, bottom: -reach, top: reach, near: 1, far: 25 });
    this.scene.add(sun, sun.target);
  }

  addGeoms(model) {
    const groups = new Map(); // geometries by body and opacity
    this.boxes = []; // extent of every geom but planes, with its body
    for (let geom = 0; geom < model.ngeom; geom++) {
      const alpha = model.geom_rgba[4 * geom + 3];
      if (model.geom_group[geom] === HIDDEN_GROUP || alpha === 0) continue;
      const geometry = this.geometry(model, geom);
      const key = `${model.geom_bodyid[geom]} ${alpha}`;
      if (geometry === null) continue;
      groups.set(key, [...(groups.get(key) ?? []), geometry]);
      geometry.computeBoundingBox();
      if (model.geom_type[geom] !== 0) this.boxes.push([model.geom_bodyid[geom], geometry.boundingBox]);
    }
    for (const [key, geometries] of groups) {
      const [body, alpha] = key.split(' ').map(Number);
      const options = { vertexColors: true, opacity: alpha, transparent: alpha < 1 };
      if (model.body_mocapid[body] >= 0) Object.assign(options, { clippingPlanes: this.track, clipShadows: true });
      const material = this.low ? cheap(options) : new three.MeshStandardMaterial({ ...options, roughness: 0.75 });
      const drawn = new three.Mesh(mergeGeometries(geometries), material);
      drawn.castShadow = alpha === 1;
      drawn.receiveShadow = true;
      drawn.frustumCulled = body !== 0;
      this.bodies[body].add(drawn);
    }
  }

  /** Geometry of a geom in the frame of its body, with its colour, or null where it is not drawn. */
  geometry(model, geom) {
    const [type, size] = [model.geom_type[geom], part(model.geom_size, geom, 3)];
    const geometry = type === 7 ? mesh(model, model.geom_dataid[geom]) : shape(type, size, this.low ? 1 : 2);
    if (geometry === null) return null;
    geometry.applyQuaternion(quaternion(part(model.geom_quat, geom, 4)));
    geometry.translate(...part(model.geom_pos, geom, 3));
    const rgb = part(model.geom_rgba, geom, 4).slice(0, 3);
    const space = this.low ? three.LinearSRGBColorSpace : three.SRGBColorSpace;
    const color = new three.Color().setRGB(...rgb, space).toArray();
    const count = geometry.getAttribute('position').count;
    const colors = Float32Array.from({ length: 3 * count }, (_, i) => color[i % 3]);
    return geometry.setAttribute('color', new three.BufferAttribute(colors, 3));
  }

  /** Draws the bodies where `data` has them, on a canvas of which `top` and `bottom` pixels are covered. */
  draw(data, seconds, top, bottom) {
    const { xpos, xquat } = data;
    this.bodies.forEach((group, body) => {
      group.position.set(xpos[3 * body], xpos[3 * body + 1], xpos[3 * body + 2]);
      const [w, x, y, z] = part(xquat, body, 4);
      group.quaternion.set(x, y, z, w);
    });
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    const size = `${width} ${height} ${top} ${bottom}`;
    if (size !== this.size) {
      this.size = size;
      this.renderer.setSize(width, height, false);
      this.camera.resize(width, height, top, bottom);
    }
    this.camera.update(data, seconds);
    this.renderer.render(this.scene, this.camera.lens);
  }

  /** Frees the drawing's memory; its canvas cannot be used again. */
  dispose() {
    this.scene?.traverse((item) => item.geometry?.dispose());
    this.camera.dispose();
    this.renderer.dispose();
  }
}
