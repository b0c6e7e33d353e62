// The plot of accuracy against time: one mark for each quality level on a logarithmic scale of milliseconds, small ones for levels that
// were measured but are not offered, and the server's messages about the present level.
//
// One more level may be chosen: that the scene is rendered in this browser. Its cost is measured here while it plays. Its error is that
// of a server's bus of first order, which is the same sound; where that was not measured, it is a line at its cost.
//
// Errors are means over the metrics in just-noticeable differences (JND); smaller is better.

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT] = [296, 132];
const MARGIN = { left: 26, right: 38, top: 12, bottom: 22 };
export const HERE = "in-this-browser"; // the level that no server renders
const KEPT = 3; // messages about changes that stay visible
const REASONS = {
  chosen: "as you chose",
  load: "the server has too much to do",
  recovered: "the server has time again",
};

const milliseconds = (value) => `${value < 0.1 ? value.toPrecision(1) : value < 1 ? value.toFixed(2) : Number(value.toPrecision(2))} ms`;
const costOf = (level) => level.ms_mean ?? level.ms_here;
// The time measured here is for a new response. With levels that reuse responses, most poses of a walk need none.
const hereOf = (level) => (level.ms_mean === null || level.ms_here === null ? level.ms_here : (level.ms_here * level.ms_mean) / level.ms_miss);
const isSoundHere = (level) => level.bus === 1 && level.audible !== null;
const isPlaced = (level) => level.audible !== null && costOf(level) !== null;

function draw(name, attributes, parent, text) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, typeof value === "number" ? +value.toFixed(2) : value);
  if (text !== undefined) node.textContent = text;
  parent?.append(node);
  return node;
}

export class Frontier extends EventTarget {
  #chart;
  #choice;
  #name;
  #note;
  #changes;
  #levels = [];
  #heard = null;
  #offersHere = false;
  #msHere = null; // of a response in this browser
  #wish = null; // a level that was chosen before the levels were known
  #history = []; // {at, level, text}, newest first

  /** `root` is the section. Emits "chosen" with a level's name or "auto". */
  constructor(root) {
    super();
    const find = (id) => root.querySelector(`#${id}`);
    this.#chart = find("frontier");
    this.#choice = find("level-choice");
    this.#name = find("level");
    this.#note = find("level-note");
    this.#changes = find("level-changes");
    this.#choice.addEventListener("change", () => this.#choose());
  }

  /** Name of the chosen level, or "auto". */
  get chosen() {
    return this.#wish ?? (this.#choice.value || "auto");
  }

  /** Chooses a level without an event. */
  set chosen(name) {
    if (this.#levels.length === 0) this.#wish = name;
    else this.#choice.value = name;
  }

  show({ levels }) {
    const { chosen } = this;
    this.#wish = null;
    this.#levels = levels;
    const options = levels.filter(({ is_offered: isOffered }) => isOffered).reverse().map((level) => {
      const cost = hereOf(level) ?? level.ms_mean;
      const option = new Option(cost === null ? level.title : `${level.title}, ${milliseconds(cost)}`, level.name);
      option.title = level.name;
      return option;
    });
    const here = this.#offersHere ? [new Option(this.#titleHere, HERE)] : [];
    this.#choice.replaceChildren(new Option("Automatic", "auto"), ...here, ...options);
    this.#choice.value = [...this.#choice.options].some(({ value }) => value === chosen) ? chosen : "auto";
    this.#choice.disabled = false;
    this.#draw();
  }

  /** Whether the scene can be rendered in this browser. */
  set offersHere(offersHere) {
    this.#offersHere = offersHere;
  }

  /** Takes the median time of a response in this browser, in milliseconds. */
  set msHere(ms) {
    this.#msHere = ms;
    const option = [...this.#choice.options].find(({ value }) => value === HERE);
    if (option) option.textContent = this.#titleHere;
    this.#draw();
  }

  get #titleHere() {
    return this.#msHere === null ? "In this browser" : `In this browser, ${milliseconds(this.#msHere)}`;
  }

  /** Shows the reason why there is nothing to show yet. */
  fail(reason) {
    if (this.#levels.length === 0) this.#note.textContent = `not available: ${reason}`;
  }

  /** Sets the present level; null while no stream is open. */
  set heard(name) {
    this.#heard = name;
    this.#draw();
  }

  /** Shows a message from the server about a change of level. */
  changed({ level, reason, ir_rate_hz: rateHz }) {
    const pace = rateHz === null ? "" : `, at most ${+rateHz.toFixed(1)} responses a second`;
    const title = this.#levels.find(({ name }) => name === level)?.title ?? level;
    this.#history.unshift({ at: new Date(), level, text: `${title}${pace}: ${REASONS[reason] ?? reason}` });
    this.#history.length = Math.min(this.#history.length, KEPT);
    this.#changes.replaceChildren(
      ...this.#history.map(({ at, level: name, text }) => {
        const item = document.createElement("li");
        item.title = name;
        const time = document.createElement("time");
        time.textContent = at.toLocaleTimeString([], { hour12: false });
        item.append(time, ` ${text}`);
        return item;
      }),
    );
    this.heard = level;
  }

  #choose(name = this.#choice.value) {
    this.#wish = null;
    this.#choice.value = name;
    this.dispatchEvent(new CustomEvent("chosen", { detail: name }));
  }

  #draw() {
    const here = { name: HERE, title: "In this browser", ms_mean: null, ms_here: this.#msHere };
    const heard = [...this.#levels, here].find(({ name }) => name === this.#heard);
    this.#name.textContent = heard ? heard.title : "–";
    this.#name.title = heard ? heard.name : "";
    this.#name.classList.toggle("long", this.#name.textContent.length > 16);
    const cost = heard ? hereOf(heard) : null;
    this.#note.textContent = heard ? (cost === null ? "" : `${milliseconds(cost)} here`.replaceAll(" ", "\u00a0")) : "once playing";
    this.#chart.replaceChildren();
    const placed = this.#levels.filter(isPlaced);
    this.#chart.parentElement.hidden = placed.length === 0;
    if (placed.length === 0) return;
    const { x, y } = this.#axes(placed);
    const floors = placed.map((level) => level.audible_floor).filter((floor) => floor !== null);
    if (floors.length > 0) this.#floor(y(Math.min(...floors)));
    // A bus that is not offered is there for the browser's sake, and no step of the server's.
    const steps = placed.filter(({ is_offered: isOffered, bus }) => isOffered || bus === null).sort((a, b) => costOf(a) - costOf(b));
    const line = steps.map((level) => `${x(costOf(level)).toFixed(1)} ${y(level.audible).toFixed(1)}`);
    draw("path", { class: "through", d: `M${line.join("L")}` }, this.#chart);
    if (this.#msHere !== null) this.#markHere(x, y);
    for (const level of placed) this.#mark(level, x, y);
  }

  #axes(placed) {
    const costs = placed.flatMap((level) => [level.ms_mean, hereOf(level)]).filter((cost) => cost !== null);
    if (this.#msHere !== null) costs.push(this.#msHere);
    // Half a decade on either side, so that the axis has at least one power of ten.
    const low = Math.log10(Math.min(...costs)) - 0.5;
    const high = Math.log10(Math.max(...costs)) + 0.5;
    const worst = Math.max(...placed.map(({ audible, audible_floor: floor }) => Math.max(audible, floor ?? 0)));
    const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20].find((value) => worst / value <= 4) ?? worst;
    const top = step * Math.ceil((1.05 * worst) / step);
    const [left, right] = [MARGIN.left, WIDTH - MARGIN.right];
    const [above, below] = [MARGIN.top, HEIGHT - MARGIN.bottom];
    const x = (ms) => left + ((right - left) * (Math.log10(ms) - low)) / (high - low);
    const y = (jnd) => below - ((below - above) * jnd) / top;
    for (let value = 0; value <= top + step / 2; value += step) {
      draw("path", { class: "grid", d: `M${left} ${y(value).toFixed(1)}H${right}` }, this.#chart);
      draw("text", { x: left - 6, y: y(value) + 3.5, class: "tick end" }, this.#chart, +value.toFixed(1));
    }
    for (let power = Math.ceil(low); power <= high; power++) {
      const at = x(10 ** power);
      draw("path", { class: "grid", d: `M${at.toFixed(1)} ${below}v4` }, this.#chart);
      draw("text", { x: at, y: HEIGHT - 5, class: "tick" }, this.#chart, `${+(10 ** power).toPrecision(1)}`);
    }
    return { x, y };
  }

  #floor(at) {
    draw("path", { class: "floor", d: `M${MARGIN.left} ${at.toFixed(1)}H${WIDTH - MARGIN.right}` }, this.#chart);
    // Beside the plot, so that it covers no point.
    draw("text", { x: WIDTH - MARGIN.right + 6, y: at + 3.5, class: "tick start floor-label" }, this.#chart, "floor");
  }

  #markHere(x, y) {
    const isHeard = this.#heard === HERE;
    const mark = draw("g", { class: isHeard ? "in-browser heard" : "in-browser", "data-level": HERE }, this.#chart);
    const at = x(this.#msHere);
    const sound = this.#levels.find(isSoundHere);
    if (sound === undefined) {
      draw("path", { d: `M${at.toFixed(1)} ${MARGIN.top}V${HEIGHT - MARGIN.bottom}` }, mark);
    } else {
      if (isHeard) draw("circle", { class: "halo", cx: at, cy: y(sound.audible), r: 8 }, mark);
      draw("circle", { class: "dot", cx: at, cy: y(sound.audible), r: 4 }, mark);
      draw("circle", { class: "touch", cx: at, cy: y(sound.audible), r: 11 }, mark);
      mark.addEventListener("click", () => this.#choose(HERE));
    }
    const error = sound === undefined ? "" : `error ${sound.audible.toFixed(2)} JND, `;
    draw("title", {}, mark, `In this browser: ${error}${milliseconds(this.#msHere)} a response, measured here`);
  }

  #mark(level, x, y) {
    const isHeard = level.name === this.#heard;
    const kind = level.is_offered ? (isHeard ? "level heard" : "level") : "measured";
    const mark = draw("g", { class: kind, "data-level": level.name }, this.#chart);
    const [at, height] = [x(costOf(level)), y(level.audible)];
    if (level.ms_here !== null && level.ms_mean !== null) {
      draw("path", { class: "here", d: `M${at.toFixed(1)} ${height.toFixed(1)}H${x(hereOf(level)).toFixed(1)}m0 -3.5v7` }, mark);
    }
    if (isHeard) draw("circle", { class: "halo", cx: at, cy: height, r: 8 }, mark);
    draw("circle", { class: "dot", cx: at, cy: height, r: level.is_offered ? 4 : 2.5 }, mark);
    draw("circle", { class: "touch", cx: at, cy: height, r: level.is_offered ? 11 : 4 }, mark);
    const floor = level.audible_floor === null ? "" : `, floor ${level.audible_floor.toFixed(2)}`;
    const here = level.ms_here === null ? "" : `, ${milliseconds(hereOf(level))} on this server`;
    const bundled = level.ms_mean === null ? "" : `, ${milliseconds(level.ms_mean)} a pose where it was made`;
    const steps = Object.values(level.steps ?? {});
    const step = steps.length === 0 ? "" : `, steps of up to ${Math.max(...steps).toFixed(1)} JND`;
    const unoffered = level.is_offered ? "" : ", measured but not offered";
    draw("title", {}, mark, `${level.title} (${level.name}): error ${level.audible.toFixed(2)} JND${floor}${step}${bundled}${here}${unoffered}`);
    if (!level.is_offered) return;
    mark.addEventListener("click", () => this.#choose(level.name));
  }
}
