// The page: messages in, person on the stage, figures on the HUD.

import "./style.css";
import { connect } from "./connection.js";
import { Hud } from "./hud.js";
import { Person } from "./person.js";
import { Points } from "./points.js";
import { SkeletonOverlay } from "./skeleton.js";
import { Stage } from "./stage.js";

const WITHHELD_PRESENCE = 0.6;

const hud = new Hud();
const stage = openStage(document.getElementById("stage"));
const person = new Person(stage.scene);
person.blends = !stage.modest || new URLSearchParams(location.search).has("blend"); // in software it takes too long
const points = new Points(stage.scene);
const skeleton = new SkeletonOverlay(stage.scene);

let newest = null; // the frame to draw next; an older one not drawn yet is skipped
let capturedAt = NaN; // when what is on screen was captured, on this page's clock
let drawnAt = performance.now();
let withheld = false; // the last good picture is kept
let mode = null; // "mesh", "live" or "points": the receiver's choice until somebody's here
let chosen = null;
let surface = "mesh"; // the mode that is not points

const receiver = connect({
  hello({ link_parents, skinning, mode: first }) {
    person.clear(); // a new connection starts with an empty repository
    points.clear();
    setMode(chosen ?? first);
    if (mode !== first) receiver.send(mode);
    if (!person.blends) receiver.send("alone");
    person.skinning = skinning;
    skeleton.setLinks(link_parents);
  },
  status(status) {
    hud.setStatus(status);
    setPresence();
  },
  async pose(message) {
    await person.add(message);
    stage.changed = true;
  },
  remove({ poseId }) {
    person.remove(poseId);
    stage.changed = true;
  },
  points(message) {
    points.set(message);
    setMode(mode);
  },
  live(message) {
    person.setSurface(message);
  },
  frame(frame) {
    newest = { ...frame, capturedAt: performance.now() - frame.ageMs };
  },
  outdated: () => hud.setState("outdated"),
  closed() {
    hud.setState("disconnected");
    setPresence();
  },
});

function openStage(canvas) {
  canvas.addEventListener("webglcontextrestored", () => location.reload()); // the meshes were on the GPU alone
  try {
    return new Stage(canvas);
  } catch (error) {
    hud.setState("unable");
    throw error;
  }
}

function setMode(value) {
  mode = value;
  document.body.dataset.mode = mode;
  if (mode !== "points") surface = mode;
  points.visible = mode === "points";
  person.visible = mode !== "points";
  person.follows = mode === "live";
  hud.setPointsMissing(mode === "points" && !points.any);
  stage.changed = true;
}

function setPresence() {
  const held = withheld && mode !== "points"; // points are shown in every posture
  hud.setWithheld(held && hud.live);
  person.presence = !hud.live ? 0 : held ? WITHHELD_PRESENCE : 1;
  points.presence = hud.live ? 1 : 0;
  stage.changed = true;
}

function draw(now) {
  requestAnimationFrame(draw);
  if (newest) {
    person.show(newest);
    points.show(newest);
    skeleton.show(newest);
    stage.follow(newest.joints, (now - drawnAt) / 1000);
    if (!newest.withheld || mode === "points") hud.countFrame();
    withheld = newest.withheld;
    setPresence();
    capturedAt = newest.capturedAt;
    newest = null;
    drawnAt = now;
  }
  stage.draw(person);
  hud.tick(now, performance.now() - capturedAt);
}
requestAnimationFrame(draw);

const KEYS = {
  s: () => skeleton.toggle(),
  p: () => choose(mode === "points" ? surface : "points"),
  l: () => choose(mode === "live" ? "mesh" : "live"),
  r: () => stage.front(),
  h: () => document.body.classList.toggle("quiet"),
};

function choose(value) {
  chosen = value;
  setMode(chosen);
  setPresence();
  receiver.send(chosen);
}

function press(key) {
  KEYS[key]?.();
  stage.changed = true;
}

addEventListener("keydown", (event) => {
  if (!event.ctrlKey && !event.metaKey && !event.altKey && !event.repeat) press(event.key.toLowerCase());
});
for (const button of document.querySelectorAll("[data-key]")) {
  button.addEventListener("click", () => press(button.dataset.key));
}
