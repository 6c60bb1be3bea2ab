// The person: each candidate pose's mesh and texture are on the GPU once; a frame moves it by one rigid motion per link.

import * as THREE from "three";
import { LINKS } from "./messages.js";

const vertexShader = /* glsl */ `
  uniform vec3 boxMin;
  uniform vec3 boxSize;
  uniform vec4 motion[${3 * LINKS}];  // the rows of a 3x4 matrix per link
  in float link;
  out vec2 at;

  void main() {
    vec4 captured = vec4(boxMin + boxSize * position, 1.0);
    int row = 3 * int(link + 0.5);
    vec3 now = vec3(dot(motion[row], captured), dot(motion[row + 1], captured), dot(motion[row + 2], captured));
    at = uv;
    gl_Position = projectionMatrix * viewMatrix * vec4(now, 1.0);
  }`;

// Unlit: the cameras' colours already hold the light of the room.
const fragmentShader = /* glsl */ `
  uniform sampler2D atlas;
  uniform float presence;
  in vec2 at;
  out vec4 colour;

  void main() {
    vec3 shade = texture(atlas, at).rgb;
    vec3 faded = mix(vec3(dot(shade, vec3(0.3, 0.59, 0.11)) * 0.45), shade, presence);
    colour = vec4(faded, 1.0);
  }`;

export class Person {
  constructor(scene) {
    this.group = new THREE.Group();
    scene.add(this.group);
    this.meshes = new Map(); // of all poses; those in the group can be shown
    this.frame = null; // the last one to show
    this.shared = {
      motion: { value: new Float32Array(12 * LINKS) },
      presence: { value: 1 },
    };
  }

  /** The pose can be shown when its texture is decoded; by then it may have been removed. */
  async add(message) {
    const { poseId, jpeg } = message;
    this.remove(poseId);
    const mesh = meshOf(message, this.shared);
    this.meshes.set(poseId, mesh);
    const picture = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }), { colorSpaceConversion: "none" });
    if (this.meshes.get(poseId) !== mesh) return picture.close();
    mesh.material.uniforms.atlas.value = textureOf(picture);
    this.group.add(mesh);
    if (this.frame?.poseId === poseId) this.show(this.frame);
  }

  remove(poseId) {
    const mesh = this.meshes.get(poseId);
    if (!mesh) return;
    this.meshes.delete(poseId);
    this.group.remove(mesh);
    mesh.geometry.dispose();
    mesh.material.uniforms.atlas.value?.dispose();
    mesh.material.dispose();
  }

  clear() {
    for (const poseId of [...this.meshes.keys()]) this.remove(poseId);
    this.frame = null;
  }

  /** Shows the frame's pose, nobody if it has none; while its mesh is not ready yet the last one stays as it was. */
  show(frame) {
    const { poseId, motion } = frame;
    this.frame = frame;
    if (poseId !== null && !this.meshes.get(poseId)?.parent) return;
    this.shared.motion.value.set(motion);
    for (const [id, mesh] of this.meshes) mesh.visible = id === poseId;
  }

  /** 1 = live, 0 = grey: the picture is old. */
  set presence(value) {
    this.shared.presence.value = value;
  }
}

function meshOf({ boxMin, boxSize, positions, uv, links, indices }, shared) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", onGpuOnly(new THREE.BufferAttribute(positions, 3, true)));
  geometry.setAttribute("uv", onGpuOnly(new THREE.BufferAttribute(uv, 2, true)));
  geometry.setAttribute("link", onGpuOnly(new THREE.BufferAttribute(links, 1)));
  geometry.setIndex(onGpuOnly(new THREE.BufferAttribute(indices, 1)));
  geometry.boundingSphere = new THREE.Sphere(); // else three.js reads every vertex, to sort one mesh
  const material = new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader,
    fragmentShader,
    uniforms: {
      ...shared,
      atlas: { value: null },
      boxMin: { value: new THREE.Vector3(...boxMin) },
      boxSize: { value: new THREE.Vector3(...boxSize) },
    },
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false; // its bounds are those of the capture, not of now
  mesh.visible = false;
  return mesh;
}

/** Colours go to the screen as they were sent: no colour space, no mip-maps. */
function textureOf(picture) {
  const texture = new THREE.Texture(picture);
  texture.generateMipmaps = false;
  texture.minFilter = THREE.LinearFilter;
  texture.flipY = false; // row 0 of a picture is its top, as in uv
  texture.onUpdate = () => picture.close();
  texture.needsUpdate = true;
  return texture;
}

function onGpuOnly(attribute) {
  attribute.onUpload(function () {
    this.array = null;
  });
  return attribute;
}
