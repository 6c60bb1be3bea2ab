// The page's end of receiver/viewer/page_messages.py: typed arrays read in place, little-endian.

export const VERSION = 8;
const KINDS = { 1: decodePose, 2: decodeFrame, 3: decodeRemove, 4: decodePoints, 5: decodeLive };
const NO_POSE = 0xffffffff;
export const LINKS = 23;

/** One message as {kind, ...}: JSON text or binary. */
export function decodeMessage(data) {
  if (typeof data === "string") return JSON.parse(data);
  const view = new DataView(data);
  return KINDS[view.getUint8(1)](data, view);
}

function decodePose(buffer, view) {
  const vertices = view.getUint32(8, true);
  const faces = view.getUint32(12, true);
  const Index = vertices <= 65536 ? Uint16Array : Uint32Array;
  const uvOffset = 40 + align(vertices * 6);
  const skinOffset = uvOffset + vertices * 4;
  const jointOffset = skinOffset + vertices * 4;
  const indexOffset = jointOffset + LINKS * 12;
  const textureOffset = indexOffset + align(faces * 3 * Index.BYTES_PER_ELEMENT);
  return {
    kind: "pose",
    poseId: view.getUint32(4, true),
    boxMin: new Float32Array(buffer, 16, 3),
    boxSize: new Float32Array(buffer, 28, 3),
    positions: new Uint16Array(buffer, 40, vertices * 3),
    uv: new Uint16Array(buffer, uvOffset, vertices * 2),
    skin: new Uint8Array(buffer, skinOffset, vertices * 4),
    joints: new Float32Array(buffer, jointOffset, LINKS * 3),
    indices: new Index(buffer, indexOffset, faces * 3),
    jpeg: new Uint8Array(buffer, textureOffset),
  };
}

function decodeFrame(buffer, view) {
  const poseId = view.getUint32(4, true);
  const others = [];
  for (let at = 24 + LINKS * 108 + align(LINKS); at < buffer.byteLength; at += 4 + LINKS * 48) {
    others.push({ poseId: view.getUint32(at, true), motion: new Float32Array(buffer, at + 4, LINKS * 12) });
  }
  return {
    kind: "frame",
    poseId: poseId === NO_POSE ? null : poseId,
    withheld: view.getUint8(2) === 1,
    live: view.getUint8(3) / 255,
    ageMs: view.getFloat32(20, true),
    motion: new Float32Array(buffer, 24, LINKS * 12),
    joints: new Float32Array(buffer, 24 + LINKS * 48, LINKS * 3),
    links: new Float32Array(buffer, 24 + LINKS * 60, LINKS * 12),
    confidence: new Uint8Array(buffer, 24 + LINKS * 108, LINKS),
    others, // what it is blended with
  };
}

function decodeRemove(buffer, view) {
  return { kind: "remove", poseId: view.getUint32(4, true) };
}

function decodePoints(buffer, view) {
  const count = view.getUint32(4, true);
  return {
    kind: "points",
    count,
    boxMin: new Float32Array(buffer, 8, 3),
    boxSize: new Float32Array(buffer, 20, 3),
    radius: view.getFloat32(32, true),
    positions: new Uint16Array(buffer, 36, count * 3),
    colours: new Uint8Array(buffer, 36 + align(count * 6), count * 4),
  };
}

function decodeLive(buffer, view) {
  const sizes = 20 + LINKS * 36;
  const places = sizes + LINKS * 8;
  return {
    kind: "live",
    poseId: view.getUint32(4, true),
    width: view.getUint32(8, true),
    height: view.getUint32(12, true),
    step: view.getFloat32(16, true),
    cylinders: new Float32Array(buffer, 20, LINKS * 9),
    sizes: new Float32Array(buffer, sizes, LINKS * 2),
    places: new Int32Array(buffer, places, LINKS * 4),
    offsets: new Uint8Array(buffer, places + LINKS * 16),
  };
}

function align(bytes) {
  return (bytes + 3) & ~3;
}
