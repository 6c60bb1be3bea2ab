// The mean of several meshes' pictures, as receiver/viewer/pose_blending.py makes it.
//
// Each mesh is drawn twice by itself: its depth first, so that of its surfaces only the nearest then adds its colour.

import * as THREE from "three";

const SAMPLES = 4;

export class Blending {
  constructor(renderer, scene, smooth) {
    this.renderer = renderer;
    this.target = new THREE.WebGLRenderTarget(1, 1, { samples: smooth ? SAMPLES : 0 });
    this.picture = overlay(this.target.texture);
    this.picture.visible = false;
    scene.add(this.picture);
  }

  /** Draws `meshes` for `camera`; the scene then shows their mean. */
  draw(meshes, camera) {
    const { renderer, target } = this;
    const size = renderer.getDrawingBufferSize(new THREE.Vector2());
    target.setSize(size.x, size.y);
    renderer.setRenderTarget(target);
    renderer.autoClear = false;
    renderer.clear();
    for (const mesh of meshes) {
      renderer.clearDepth();
      for (const pass of [DEPTH, COLOUR]) {
        Object.assign(mesh.material, pass);
        renderer.render(mesh, camera);
      }
      Object.assign(mesh.material, ALONE);
    }
    renderer.autoClear = true;
    renderer.setRenderTarget(null);
  }

  set visible(value) {
    this.picture.visible = value;
  }
}

const ALONE = { colorWrite: true, depthFunc: THREE.LessEqualDepth, blending: THREE.NormalBlending };
const DEPTH = { colorWrite: false, depthFunc: THREE.LessEqualDepth, blending: THREE.NoBlending };
const COLOUR = {
  colorWrite: true,
  depthFunc: THREE.EqualDepth,
  blending: THREE.CustomBlending,
  blendSrc: THREE.OneFactor,
  blendDst: THREE.OneFactor,
};

/** A picture with premultiplied alpha over all that was drawn before it. */
function overlay(texture) {
  const material = new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: `
      out vec2 at;
      void main() {
        at = uv;
        gl_Position = vec4(position.xy, 0.0, 1.0);
      }`,
    fragmentShader: `
      uniform sampler2D picture;
      in vec2 at;
      out vec4 colour;
      void main() {
        colour = texture(picture, at);
      }`,
    uniforms: { picture: { value: texture } },
    depthTest: false,
    depthWrite: false,
    transparent: true,
    blending: THREE.CustomBlending,
    blendSrc: THREE.OneFactor,
    blendDst: THREE.OneMinusSrcAlphaFactor,
  });
  const plane = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material);
  plane.frustumCulled = false;
  plane.renderOrder = 0.5; // after the room, before the skeleton's overlay
  return plane;
}
