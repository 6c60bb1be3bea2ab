// The skeleton overlay: joints and bones drawn over the person; pale where a link was not seen.

import * as THREE from "three";

const SEEN = new THREE.Color("#7fd8ff");
const GUESSED = new THREE.Color("#5f6b7c");

export class SkeletonOverlay {
  constructor(scene) {
    this.group = new THREE.Group();
    this.group.visible = false;
    this.group.renderOrder = 1;
    scene.add(this.group);
    this.bones = null;
  }

  setLinks(parents) {
    if (this.bones) return;
    this.links = parents.map((parent, link) => ({ parent, link }));
    const paint = new THREE.MeshBasicMaterial({ depthTest: false, transparent: true, opacity: 0.9 });
    const bone = new THREE.CylinderGeometry(0.006, 0.006, 1, 8).translate(0, 0.5, 0);
    this.joints = new THREE.InstancedMesh(new THREE.SphereGeometry(0.014, 12, 8), paint, parents.length);
    this.bones = new THREE.InstancedMesh(bone, paint, parents.length);
    for (const mesh of [this.bones, this.joints]) {
      mesh.frustumCulled = false;
      this.group.add(mesh);
    }
  }

  show({ joints, confidence }) {
    if (!this.bones) return;
    const matrix = new THREE.Matrix4();
    const turn = new THREE.Quaternion();
    const colour = new THREE.Color();
    for (const { parent, link } of this.links) {
      const end = point(joints, link);
      colour.lerpColors(GUESSED, SEEN, confidence[link] / 255);
      this.joints.setMatrixAt(link, matrix.makeTranslation(end));
      this.joints.setColorAt(link, colour);
      const start = point(joints, Math.max(parent, 0));
      const along = end.clone().sub(start);
      const length = along.length();
      turn.setFromUnitVectors(UP, along.normalize());
      this.bones.setMatrixAt(link, matrix.compose(start, turn, new THREE.Vector3(1, length, 1)));
      this.bones.setColorAt(link, colour);
    }
    for (const mesh of [this.bones, this.joints]) {
      mesh.instanceMatrix.needsUpdate = true;
      mesh.instanceColor.needsUpdate = true;
    }
  }

  toggle() {
    this.group.visible = !this.group.visible;
  }
}

const UP = new THREE.Vector3(0, 1, 0);

function point(joints, link) {
  return new THREE.Vector3().fromArray(joints, 3 * link);
}
