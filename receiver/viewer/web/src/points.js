// The person as points: each hangs on a link and is drawn as a round splat, as common/geometry/point_splats.py does.

import * as THREE from "three";
import { LINKS } from "./messages.js";

const vertexShader = /* glsl */ `
  uniform vec3 boxMin;
  uniform vec3 boxSize;
  uniform float radius;  // [m]
  uniform float height;  // of the picture [pixels]
  uniform vec4 links[${3 * LINKS}];  // the rows of T_world_link of each link
  in vec4 splat;  // colour, and the link in 1/255
  out vec3 shade;

  void main() {
    int link = int(splat.a * 255.0 + 0.5);
    vec4 p = vec4(boxMin + boxSize * position, 1.0);
    vec3 world = vec3(dot(links[3 * link], p), dot(links[3 * link + 1], p), dot(links[3 * link + 2], p));
    shade = splat.rgb;
    gl_Position = projectionMatrix * viewMatrix * vec4(world, 1.0);
    gl_PointSize = max(radius * projectionMatrix[1][1] * height / gl_Position.w, 1.0);
  }`;

const fragmentShader = /* glsl */ `
  uniform float presence;
  in vec3 shade;
  out vec4 colour;

  void main() {
    vec2 away = gl_PointCoord - 0.5;
    if (dot(away, away) > 0.25) discard;
    colour = vec4(mix(vec3(dot(shade, vec3(0.3, 0.59, 0.11)) * 0.45), shade, presence), 1.0);
  }`;

export class Points {
  constructor(scene) {
    this.uniforms = {
      boxMin: { value: new THREE.Vector3() },
      boxSize: { value: new THREE.Vector3() },
      radius: { value: 0 },
      height: { value: 1 },
      links: { value: new Float32Array(12 * LINKS) },
      presence: { value: 1 },
    };
    const material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader,
      fragmentShader,
      uniforms: this.uniforms,
    });
    this.cloud = new THREE.Points(new THREE.BufferGeometry(), material);
    this.cloud.frustumCulled = false; // its bounds are those of single links
    this.cloud.visible = false;
    this.cloud.onBeforeRender = (renderer) => {
      this.uniforms.height.value = renderer.domElement.height;
    };
    scene.add(this.cloud);
  }

  /** Whether there are any. */
  get any() {
    return (this.cloud.geometry.getAttribute("position")?.count ?? 0) > 0;
  }

  /** The points to move from now on. */
  set({ count, boxMin, boxSize, radius, positions, colours }) {
    this.cloud.geometry.dispose();
    const geometry = new THREE.BufferGeometry();
    if (count > 0) {
      geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3, true));
      geometry.setAttribute("splat", new THREE.BufferAttribute(colours, 4, true));
      geometry.boundingSphere = new THREE.Sphere(); // else three.js reads every point
    }
    this.cloud.geometry = geometry;
    this.uniforms.boxMin.value.set(...boxMin);
    this.uniforms.boxSize.value.set(...boxSize);
    this.uniforms.radius.value = radius;
  }

  clear() {
    this.cloud.geometry.dispose();
    this.cloud.geometry = new THREE.BufferGeometry();
  }

  /** Moves them to the frame's links. */
  show({ links }) {
    this.uniforms.links.value.set(links);
  }

  set visible(value) {
    this.cloud.visible = value;
  }

  /** 1 = live, 0 = grey: the picture is old. */
  set presence(value) {
    this.uniforms.presence.value = value;
  }
}
