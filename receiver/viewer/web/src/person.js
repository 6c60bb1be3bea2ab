// The person: each candidate pose's mesh and texture are on the GPU once; a frame moves it by one rigid motion per link,
// mixed at the joints as common/body/skinning.py does. Where it is to follow newer maps, live.js moves and tints it.
// A frame may name several poses, whose mean blending.js draws.

import * as THREE from "three";
import { followingShader, LiveSurface } from "./live.js";
import { LINKS } from "./messages.js";

const SKINNINGS = ["rigid", "linear", "spherical"];

const vertexShader = /* glsl */ `
  uniform vec3 boxMin;
  uniform vec3 boxSize;
  uniform int skinning;
  uniform vec4 motion[${3 * LINKS}];  // the rows of a 3x4 matrix per link
  uniform vec4 turn[${LINKS}];  // its rotation as a quaternion (x, y, z, w)
  uniform vec3 joint[${LINKS}];  // at capture
  in vec4 skin;  // link, neighbour, joint between them, the neighbour's part in 1/255
  out vec2 at;
${followingShader}
  vec3 moved(int link, vec3 point) {
    vec4 p = vec4(point, 1.0);
    return vec3(dot(motion[3 * link], p), dot(motion[3 * link + 1], p), dot(motion[3 * link + 2], p));
  }

  vec3 now(vec3 captured) {
    int link = int(skin.x + 0.5), other = int(skin.y + 0.5);
    float share = skin.w / 255.0;
    if (skinning == 0 || share == 0.0) return moved(link, captured);
    if (skinning == 1) return mix(moved(link, captured), moved(other, captured), share);
    vec3 pivot = joint[int(skin.z + 0.5)];
    vec4 q = (1.0 - share) * turn[link] + (dot(turn[link], turn[other]) < 0.0 ? -share : share) * turn[other];
    vec3 arm = captured - pivot;
    arm += 2.0 / dot(q, q) * cross(q.xyz, cross(q.xyz, arm) + q.w * arm);
    return mix(moved(link, pivot), moved(other, pivot), share) + arm;
  }

  void main() {
    at = uv;
    vec3 here = following(int(skin.x + 0.5), now(boxMin + boxSize * position));
    gl_Position = projectionMatrix * viewMatrix * vec4(here, 1.0);
  }`;

// Unlit: the cameras' colours already hold the light of the room.
const fragmentShader = /* glsl */ `
  uniform sampler2D atlas;
  uniform float presence;
  uniform float share;  // of the picture
  in vec2 at;
  in vec3 tint;
  out vec4 colour;

  void main() {
    vec3 shade = clamp(texture(atlas, at).rgb + tint, 0.0, 1.0);
    vec3 faded = mix(vec3(dot(shade, vec3(0.3, 0.59, 0.11)) * 0.45), shade, presence);
    colour = vec4(share * faded, share);
  }`;

export class Person {
  constructor(scene) {
    this.group = new THREE.Group();
    scene.add(this.group);
    this.meshes = new Map(); // of all poses; those in the group can be shown
    this.frame = null; // the last one to show
    this.surfaces = new Map(); // what maps show beyond the pose of that id: the newest message
    this.follows = false; // whether that is wanted
    this.shown = []; // the meshes on screen, the best pose's first
    this.blends = true; // several, where a frame names several; else the best one alone
    this.shared = { skinning: { value: 0 }, presence: { value: 1 } };
  }

  /** The pose can be shown when its texture is decoded; by then it may have been removed. */
  async add(message) {
    const { poseId, jpeg } = message;
    this.dispose(poseId);
    const mesh = meshOf(message, this.shared);
    this.meshes.set(poseId, mesh);
    const picture = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }), { colorSpaceConversion: "none" });
    if (this.meshes.get(poseId) !== mesh) return picture.close();
    mesh.material.uniforms.atlas.value = textureOf(picture);
    this.group.add(mesh);
    if (this.frame && [this.frame, ...this.frame.others].some((pose) => pose.poseId === poseId)) this.show(this.frame);
  }

  /** What maps show beyond the mesh of one pose; frames with that pose make use of it. */
  setSurface(message) {
    this.surfaces.set(message.poseId, message);
  }

  remove(poseId) {
    this.surfaces.delete(poseId);
    this.dispose(poseId);
  }

  dispose(poseId) {
    const mesh = this.meshes.get(poseId);
    if (!mesh) return;
    this.meshes.delete(poseId);
    this.shown = this.shown.filter((other) => other !== mesh);
    this.group.remove(mesh);
    mesh.geometry.dispose();
    mesh.material.uniforms.atlas.value?.dispose();
    mesh.userData.live.dispose();
    mesh.material.dispose();
  }

  clear() {
    for (const poseId of [...this.meshes.keys()]) this.remove(poseId);
    this.surfaces.clear();
    this.frame = null;
    this.shown = [];
  }

  /** Shows the frame's poses, nobody if it has none; while its first one is not ready yet the last stays as it was. */
  show(frame) {
    const { poseId, others } = frame;
    this.frame = frame;
    if (poseId !== null && !this.meshes.get(poseId)?.parent) return;
    const moved = poseId === null ? [] : [frame, ...(this.blends ? others : [])];
    const ready = moved.filter((pose) => this.meshes.get(pose.poseId)?.parent);
    for (const mesh of this.meshes.values()) mesh.visible = false;
    this.shown = ready.map((pose) => this.move(pose, 1 / ready.length));
  }

  move({ poseId, motion }, share) {
    const mesh = this.meshes.get(poseId);
    const uniforms = mesh.material.uniforms;
    uniforms.motion.value.set(motion);
    uniforms.turn.value.forEach((turn, link) => turn.setFromRotationMatrix(matrixOf(motion, link)));
    uniforms.share.value = share;
    const surface = this.follows ? (this.surfaces.get(poseId) ?? null) : null;
    if (!surface || !this.frame.withheld) mesh.userData.live.show(surface, this.frame); // else as it was: links have moved
    mesh.visible = true;
    return mesh;
  }

  set visible(value) {
    this.group.visible = value;
  }

  /** How the mesh bends at its joints: "rigid", "linear" or "spherical". */
  set skinning(name) {
    this.shared.skinning.value = SKINNINGS.indexOf(name);
  }

  /** 1 = live, 0 = grey: the picture is old. */
  set presence(value) {
    this.shared.presence.value = value;
  }
}

function meshOf({ boxMin, boxSize, positions, uv, skin, joints, indices }, shared) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", onGpuOnly(new THREE.BufferAttribute(positions, 3, true)));
  geometry.setAttribute("uv", onGpuOnly(new THREE.BufferAttribute(uv, 2, true)));
  geometry.setAttribute("skin", onGpuOnly(new THREE.BufferAttribute(skin, 4)));
  geometry.setIndex(onGpuOnly(new THREE.BufferAttribute(indices, 1)));
  geometry.boundingSphere = new THREE.Sphere(); // else three.js reads every vertex, to sort one mesh
  const live = new LiveSurface();
  const material = new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3,
    side: THREE.DoubleSide, // through a gap one sees the inside of the cloth, not the room
    vertexShader,
    fragmentShader,
    uniforms: {
      ...shared,
      ...live.uniforms,
      motion: { value: new Float32Array(12 * LINKS) },
      turn: { value: Array.from({ length: LINKS }, () => new THREE.Quaternion()) },
      share: { value: 1 },
      atlas: { value: null },
      boxMin: { value: new THREE.Vector3(...boxMin) },
      boxSize: { value: new THREE.Vector3(...boxSize) },
      joint: { value: joints.slice() },
    },
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false; // its bounds are those of the capture, not of now
  mesh.visible = false;
  mesh.userData.live = live;
  return mesh;
}

const matrix = new THREE.Matrix4();

/** A link's motion, three rows of four, as three.js' matrix; used until the next call. */
function matrixOf(motion, link) {
  const [a, b, c, d, e, f, g, h, i, j, k, l] = motion.subarray(12 * link, 12 * link + 12);
  return matrix.set(a, b, c, d, e, f, g, h, i, j, k, l, 0, 0, 0, 1);
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
