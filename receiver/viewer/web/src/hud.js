// The figures and the banner.

import { RegionMap } from "./regions.js";

const BANNERS = {
  connecting: ["Connecting…", ""],
  disconnected: ["Connection lost", "The receiver does not answer. This page keeps trying."],
  outdated: ["This page is out of date", "Reload it. If this stays, run ./scripts/setup where the receiver runs."],
  waiting: ["Waiting for sender…", "The picture starts as soon as telepose-send is up."],
  lost: ["Connection lost", "Nothing comes from the sender. The picture goes on by itself when it is back."],
  unable: ["This browser cannot draw in 3D", "It offers no WebGL 2. Another browser, or its settings, may help."],
  receiving: ["", ""],
};
const STATES = { "waiting for sender": "waiting", receiving: "receiving", "connection lost": "lost" };

export class Hud {
  constructor() {
    this.figures = Object.fromEntries([...document.querySelectorAll("[data-figure]")].map((e) => [e.dataset.figure, e]));
    this.title = document.getElementById("banner-title");
    this.detail = document.getElementById("banner-detail");
    this.note = document.getElementById("note");
    this.regions = new RegionMap(document.getElementById("regions"));
    this.ages = [];
    this.drawn = 0;
    this.since = performance.now();
    this.setState("connecting");
  }

  get live() {
    return document.body.dataset.state === "receiving";
  }

  setState(state, detail = "") {
    document.body.dataset.state = state;
    this.title.textContent = BANNERS[state][0];
    this.detail.textContent = detail || BANNERS[state][1];
    this.detailNote = this.live ? detail : "";
    this.writeNote();
  }

  setStatus(status) {
    this.setState(STATES[status.connection], status.detail);
    this.write("skeleton", kilobits(status.skeleton_bps));
    this.write("bulk", kilobits(status.bulk_bps));
    this.write("repository", `${status.repository_poses} poses`);
    this.write("pose", status.chosen_pose === null ? null : `#${status.chosen_pose}`);
    this.write("sigma", status.sigma?.toFixed(3));
    this.write("region", this.regions.show(status.region_sigma));
    this.receivedAgeMs = status.pose_age_ms;
  }

  /** Whether points are to be shown and none are here. */
  setPointsMissing(missing) {
    this.pointsMissing = missing;
    this.writeNote();
  }

  writeNote() {
    const missing = this.live && this.pointsMissing ? "No points yet: the sender's [residuals] may be off." : "";
    this.note.textContent = missing || this.detailNote;
  }

  /** Whether the picture is the last good one, since the newest skeleton would tear it. */
  setWithheld(withheld) {
    document.body.classList.toggle("withheld", withheld);
  }

  /** A new pose is on screen. */
  countFrame() {
    this.drawn += 1;
  }

  /**
   * At every display tick, with the age of the pose on screen then (not a number: unknown). Once a second it writes
   * how many poses were drawn and how old they were (median).
   */
  tick(now, ageMs) {
    if (Number.isFinite(ageMs)) this.ages.push(ageMs);
    const elapsed = now - this.since;
    if (elapsed < 1000) return;
    const age = this.ages.length ? this.ages.sort((a, b) => a - b)[this.ages.length >> 1] : this.receivedAgeMs;
    const shown = this.live && this.drawn > 0;
    this.write("fps", shown ? `${Math.round((1000 * this.drawn) / elapsed)} fps` : null);
    this.write("age", shown && age != null ? `${Math.round(age)} ms` : null);
    this.ages = [];
    this.drawn = 0;
    this.since = now;
  }

  write(name, text) {
    this.figures[name].textContent = text ?? "–";
  }
}

function kilobits(bitsPerSecond) {
  return `${(bitsPerSecond / 1000).toFixed(bitsPerSecond < 99_500 ? 1 : 0)} kbit/s`;
}
