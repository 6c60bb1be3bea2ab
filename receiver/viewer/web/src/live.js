// A mesh on screen follows newer maps: what they show beyond it lies in a small picture of the links' cylinders, where
// each vertex finds its own, as in common/body/live_surface.py.

import * as THREE from "three";
import { LINKS } from "./messages.js";

/** Declares `following(link, point)`, which moves a point of a link and sets `tint`, what to add to its colour. */
export const followingShader = /* glsl */ `
  uniform float live;  // how much of it: 0..1
  uniform float outwardStep;  // [m]
  uniform sampler2D offsets;  // about 128: colour, and outwards in steps
  uniform vec4 into[${3 * LINKS}];  // the rows of a 3x4 matrix per link: world to front, side and axis of its cylinder
  uniform vec2 size[${LINKS}];  // length of the bone, radius of the caps beyond its ends [m]
  uniform vec4 place[${LINKS}];  // of the link's grid: top, left, rows, columns
  out vec3 tint;

  vec4 offsetAt(vec4 grid, vec2 cell) {  // (column, row): a grid goes around its link
    float column = mod(cell.x, grid.w), row = clamp(cell.y, 0.0, grid.z - 1.0);
    return texelFetch(offsets, ivec2(grid.yx + vec2(column, row) + 0.5), 0);
  }

  vec3 following(int link, vec3 point) {
    tint = vec3(0.0);
    if (live == 0.0) return point;
    vec4 p = vec4(point, 1.0), grid = place[link];
    vec3 front = into[3 * link].xyz, side = into[3 * link + 1].xyz, axis = into[3 * link + 2].xyz;
    vec2 across = vec2(dot(into[3 * link], p), dot(into[3 * link + 1], p));
    float along = dot(into[3 * link + 2], p), bone = size[link].x, cap = size[link].y;
    float beyond = along < 0.0 ? along : max(along - bone, 0.0);
    float height = clamp(along, 0.0, bone) + cap * atan(beyond, length(across));
    float arc = cap * ${Math.PI / 2};
    vec2 cell = vec2(atan(across.y, across.x) / ${2 * Math.PI} + 0.5, (height + arc) / (bone + 2.0 * arc)) * grid.wz - 0.5;
    vec2 first = floor(cell), share = cell - first;
    vec4 above = mix(offsetAt(grid, first), offsetAt(grid, first + vec2(1.0, 0.0)), share.x);
    vec4 below = mix(offsetAt(grid, first + vec2(0.0, 1.0)), offsetAt(grid, first + vec2(1.0, 1.0)), share.x);
    vec4 offset = live * (mix(above, below, share.y) - 128.0 / 255.0);
    tint = offset.rgb;
    vec3 outward = vec3(across, beyond);
    outward *= offset.a * 255.0 * outwardStep / max(length(outward), 1e-4);
    return point + outward.x * front + outward.y * side + outward.z * axis;
  }
`;

export class LiveSurface {
  constructor() {
    this.loaded = null; // the message that is on the GPU
    this.uniforms = {
      live: { value: 0 },
      outwardStep: { value: 0 },
      offsets: { value: null },
      into: { value: new Float32Array(12 * LINKS) },
      size: { value: new Float32Array(2 * LINKS) },
      place: { value: new Float32Array(4 * LINKS) },
    };
  }

  /** The mesh follows by `live`, 0..1, what the message says, its links being where the frame has them; null: nothing. */
  show(message, { live, links }) {
    const follows = message !== null && live > 0;
    this.uniforms.live.value = follows ? live : 0;
    if (!follows) return;
    if (this.loaded !== message) this.load(message);
    for (let link = 0; link < LINKS; link++) this.setInto(link, links.subarray(12 * link, 12 * link + 12));
  }

  dispose() {
    this.uniforms.offsets.value?.dispose();
  }

  load(message) {
    const { offsets, size, place, outwardStep } = this.uniforms;
    const image = offsets.value?.image;
    if (image?.width === message.width && image.height === message.height) image.data = message.offsets;
    else {
      this.dispose();
      offsets.value = new THREE.DataTexture(message.offsets, message.width, message.height);
    }
    offsets.value.needsUpdate = true;
    size.value.set(message.sizes);
    place.value.set(message.places);
    outwardStep.value = message.step;
    this.loaded = message;
  }

  /** World to the link's cylinder: C · T⁻¹, of C's rows and the rows of T_world_link. */
  setInto(link, [a, b, c, x, d, e, f, y, g, h, i, z]) {
    for (let row = 0; row < 3; row++) {
      const [p, q, r] = this.loaded.cylinders.subarray(9 * link + 3 * row, 9 * link + 3 * row + 3);
      const u = p * a + q * b + r * c;
      const v = p * d + q * e + r * f;
      const w = p * g + q * h + r * i;
      this.uniforms.into.value.set([u, v, w, -(u * x + v * y + w * z)], 12 * link + 4 * row);
    }
  }
}
