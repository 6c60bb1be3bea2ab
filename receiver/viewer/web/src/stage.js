// The room: floor, camera and its controls. It draws only when something changed.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Blending } from "./blending.js";

const EYE_HEIGHT_M = 0.95; // the middle of a standing person
const SEEN_HEIGHT_M = 2.5;
const SEEN_WIDTH_M = 2.0; // arms spread
const FRONT = new THREE.Vector3(0.42, 0.2, 1).normalize();
const FOLLOW_S = 0.8;

export class Stage {
  constructor(canvas) {
    this.modest = drawsInSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.modest, alpha: true });
    this.renderer.setPixelRatio(this.modest ? 1 : Math.min(devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.blending = new Blending(this.renderer, this.scene, !this.modest);
    this.scene.add(floor());
    this.shadow = softShadow();
    this.scene.add(this.shadow);
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.1, 60);
    canvas.camera = this.camera; // for whoever compares the picture with another renderer's
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enablePan = false; // the camera follows the person by itself
    this.controls.minDistance = 0.8;
    this.controls.maxDistance = 14;
    this.controls.maxPolarAngle = Math.PI * 0.53;
    this.controls.addEventListener("change", () => (this.changed = true));
    this.centre = null; // where the person stands (x, z), once seen
    this.resize();
    this.front();
    addEventListener("resize", () => this.resize());
  }

  /** The view one starts with: the person from the front, as large as the window allows. */
  front() {
    const halfHeight = Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const distance = Math.max(SEEN_HEIGHT_M / 2 / halfHeight, SEEN_WIDTH_M / 2 / (halfHeight * this.camera.aspect));
    this.controls.target.set(this.centre?.x ?? 0, EYE_HEIGHT_M, this.centre?.z ?? 0);
    this.camera.position.copy(this.controls.target).addScaledVector(FRONT, distance);
    this.controls.update();
  }

  resize() {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.camera.updateProjectionMatrix();
    this.changed = true;
  }

  /** Keeps the person (pelvis at `joints[0..2]`) in the middle: at once when first seen, gently afterwards. */
  follow(joints, elapsedS) {
    const pelvis = new THREE.Vector3(joints[0], EYE_HEIGHT_M, joints[2]);
    const share = this.centre ? 1 - Math.exp(-elapsedS / FOLLOW_S) : 1;
    this.centre = pelvis;
    this.shadow.position.set(pelvis.x, 0.003, pelvis.z);
    this.shadow.visible = true;
    const step = pelvis.sub(this.controls.target).setY(0).multiplyScalar(share);
    this.controls.target.add(step);
    this.camera.position.add(step);
    this.controls.update();
    this.changed = true;
  }

  /** The room, and in it the person as one mesh, or as the mean of several. */
  draw(person) {
    if (!this.changed) return;
    this.changed = false;
    const blended = person.group.visible && person.shown.length > 1;
    for (const mesh of person.shown) mesh.visible = true;
    if (blended) this.blending.draw(person.shown, this.camera);
    for (const mesh of person.shown) mesh.visible = !blended; // in the scene
    this.blending.visible = blended;
    this.renderer.render(this.scene, this.camera);
  }
}

/** No GPU: smooth edges would cost three quarters of the frame rate. */
function drawsInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const renderer = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(renderer);
}

/** Half-metre lines that fade away with distance. */
function floor() {
  const material = new THREE.ShaderMaterial({
    transparent: true,
    depthWrite: false,
    side: THREE.DoubleSide,
    vertexShader: `
      varying vec2 ground;
      void main() {
        ground = position.xy;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      }`,
    fragmentShader: `
      varying vec2 ground;
      float line(float spacing) {
        vec2 cell = ground / spacing;
        vec2 away = abs(fract(cell - 0.5) - 0.5) / fwidth(cell);
        return 1.0 - min(min(away.x, away.y), 1.0);
      }
      void main() {
        float fade = 1.0 - smoothstep(1.2, 5.0, length(ground));
        gl_FragColor = vec4(0.62, 0.70, 0.80, fade * (0.10 * line(0.5) + 0.10 * line(1.0)));
      }`,
  });
  const plane = new THREE.Mesh(new THREE.PlaneGeometry(12, 12), material);
  plane.rotation.x = -Math.PI / 2;
  return plane;
}

/** A round darkening under the person: without it people seem to float. */
function softShadow() {
  const material = new THREE.ShaderMaterial({
    transparent: true,
    depthWrite: false,
    vertexShader: `
      varying vec2 at;
      void main() {
        at = uv * 2.0 - 1.0;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      }`,
    fragmentShader: `
      varying vec2 at;
      void main() {
        float away = 1.0 - min(length(at), 1.0);
        gl_FragColor = vec4(0.0, 0.0, 0.0, 0.38 * away * away);
      }`,
  });
  const disc = new THREE.Mesh(new THREE.PlaneGeometry(1.5, 1.5), material);
  disc.rotation.x = -Math.PI / 2;
  disc.visible = false;
  return disc;
}
