// The person: each candidate pose's mesh is on the GPU once; a frame moves it by one rigid motion per link.

import * as THREE from "three";
import { LINKS } from "./messages.js";

const vertexShader = /* glsl */ `
  uniform vec3 boxMin;
  uniform vec3 boxSize;
  uniform vec4 motion[${3 * LINKS}];  // the rows of a 3x4 matrix per link
  in vec4 colourAndLink;
  out vec3 shade;

  void main() {
    vec4 captured = vec4(boxMin + boxSize * position, 1.0);
    int row = 3 * int(colourAndLink.a * 255.0 + 0.5);
    vec3 now = vec3(dot(motion[row], captured), dot(motion[row + 1], captured), dot(motion[row + 2], captured));
    shade = colourAndLink.rgb;
    gl_Position = projectionMatrix * viewMatrix * vec4(now, 1.0);
  }`;

// Unlit: the cameras' colours already hold the light of the room.
const fragmentShader = /* glsl */ `
  uniform float presence;
  in vec3 shade;
  out vec4 colour;

  void main() {
    vec3 faded = mix(vec3(dot(shade, vec3(0.3, 0.59, 0.11)) * 0.45), shade, presence);
    colour = vec4(faded, 1.0);
  }`;

export class Person {
  constructor(scene) {
    this.group = new THREE.Group();
    scene.add(this.group);
    this.meshes = new Map();
    this.shared = {
      motion: { value: new Float32Array(12 * LINKS) },
      presence: { value: 1 },
    };
  }

  add({ poseId, boxMin, boxSize, positions, coloursAndLinks, indices }) {
    this.remove(poseId);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", onGpuOnly(new THREE.BufferAttribute(positions, 3, true)));
    geometry.setAttribute("colourAndLink", onGpuOnly(new THREE.BufferAttribute(coloursAndLinks, 4, true)));
    geometry.setIndex(onGpuOnly(new THREE.BufferAttribute(indices, 1)));
    geometry.boundingSphere = new THREE.Sphere(); // else three.js reads every vertex, to sort one mesh
    const material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader,
      fragmentShader,
      uniforms: {
        ...this.shared,
        boxMin: { value: new THREE.Vector3(...boxMin) },
        boxSize: { value: new THREE.Vector3(...boxSize) },
      },
    });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false; // its bounds are those of the capture, not of now
    mesh.visible = false;
    this.meshes.set(poseId, mesh);
    this.group.add(mesh);
  }

  remove(poseId) {
    const mesh = this.meshes.get(poseId);
    if (!mesh) return;
    this.meshes.delete(poseId);
    this.group.remove(mesh);
    mesh.geometry.dispose();
    mesh.material.dispose();
  }

  clear() {
    for (const poseId of [...this.meshes.keys()]) this.remove(poseId);
  }

  /** Shows the frame's pose, nobody if it has none; while its mesh is not here yet the last one stays as it was. */
  show({ poseId, motion }) {
    if (poseId !== null && !this.meshes.has(poseId)) return;
    this.shared.motion.value.set(motion);
    for (const [id, mesh] of this.meshes) mesh.visible = id === poseId;
  }

  /** 1 = live, 0 = grey: the picture is old. */
  set presence(value) {
    this.shared.presence.value = value;
  }
}

function onGpuOnly(attribute) {
  attribute.onUpload(function () {
    this.array = null;
  });
  return attribute;
}
