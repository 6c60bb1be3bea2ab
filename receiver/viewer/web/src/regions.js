// A small figure, seen from the front, whose regions are coloured by their distortion: green as captured, red torn, grey
// where the mesh shows nothing of a region.

const SVG = "http://www.w3.org/2000/svg";
const HALF_WAY = 0.2; // the σ_r in the middle of the colours
const UNSEEN = "rgb(255 255 255 / 9%)";

// Regions as strokes: x1, y1, x2, y2, width. Those of a side are drawn for the left one.
const MIDDLE = {
  head: [0, 7, 0, 9, 10],
  neck: [0, 16, 0, 17, 4],
  upper_spine: [0, 24, 0, 29, 11],
  lower_spine: [0, 36, 0, 39, 10],
  pelvis: [-2.5, 47, 2.5, 47, 7],
};
const SIDE = {
  clavicle: [6.5, 20.5, 8.5, 21, 4.5],
  upper_arm: [12.5, 23, 15.5, 33, 4.5],
  forearm: [17, 38, 19.5, 47, 4],
  palm: [20.5, 51.5, 21, 53.5, 3.6],
  thumb: [17.2, 52.5, 16.6, 55, 1.8],
  fingers: [21.6, 57.5, 22.2, 60.5, 3],
  thigh: [5, 54.5, 6, 67, 6.5],
  shin: [6.4, 73.5, 6.8, 86, 5],
  foot: [7, 91.5, 8, 93, 3.6],
  toes: [10.5, 95.5, 12.5, 96.5, 3],
};

export class RegionMap {
  constructor(svg) {
    this.svg = svg;
    this.lines = new Map();
  }

  /** Colours the figure by {region: σ_r}; the most distorted one as text, null without any. */
  show(sigmas) {
    const regions = Object.entries(sigmas);
    if (!regions.length) return null;
    if (!this.lines.size) this.draw();
    for (const [name, line] of this.lines) {
      line.setAttribute("stroke", name in sigmas ? colourOf(sigmas[name]) : UNSEEN);
    }
    const [name, sigma] = regions.reduce((worst, region) => (region[1] > worst[1] ? region : worst));
    return `${name.replaceAll("_", " ")} ${sigma.toFixed(3)}`;
  }

  draw() {
    for (const [name, stroke] of Object.entries(MIDDLE)) this.line(name, stroke, 1);
    for (const [name, stroke] of Object.entries(SIDE)) {
      this.line(`left_${name}`, stroke, 1); // the person's left is to the right of who looks at it
      this.line(`right_${name}`, stroke, -1);
    }
  }

  line(name, [x1, y1, x2, y2, width], side) {
    const line = document.createElementNS(SVG, "line");
    const places = { x1: side * x1, y1, x2: side * x2, y2, "stroke-width": width };
    for (const [key, value] of Object.entries(places)) line.setAttribute(key, value);
    this.svg.append(line);
    this.lines.set(name, line);
  }
}

function colourOf(sigma) {
  const share = sigma / (sigma + HALF_WAY);
  return `hsl(${Math.round(155 * (1 - share))} 58% ${Math.round(52 + 8 * share)}%)`;
}
