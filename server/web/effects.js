// The panel of effects: which are on, why, and what each costs or saves. Each can be switched to hear the difference.
//
// The server decides each effect for each source or for the whole stream. A row sums up its decisions about one effect.

const SHOWN_JND = 10; // change at the bar's full length
const TITLES = {
  hrtf: "head",
  per_source_tail: "own late tails",
};
const titleOf = (name) => TITLES[name] ?? name.replaceAll("_", " ");
const unbroken = (text) => text.replace(/(?<=\d) (?=\S)/g, "\u00a0"); // no line break between a number and its unit
const microseconds = (value) => `${value < 10 ? value.toPrecision(2) : Math.round(value)} µs`;

function element(tag, className, text) {
  const node = document.createElement(tag);
  node.className = className;
  if (text !== undefined) node.textContent = text;
  return node;
}

/** One entry for each effect in a plan's decisions. It is on if it is on for any source, and has the most audible decision's values. */
export function summarise(decisions) {
  const effects = new Map();
  for (const decision of decisions) {
    const known = effects.get(decision.name);
    if (!known) {
      effects.set(decision.name, { ...decision, count: 1, on: +decision.called_for });
      continue;
    }
    known.count += 1;
    known.on += +decision.called_for;
    known.overridden ||= decision.overridden;
    if (decision.cost_us !== null) known.cost_us = (known.cost_us ?? 0) + decision.cost_us;
    const tells = decision.called_for === known.called_for ? decision.change_jnd > known.change_jnd : decision.called_for;
    if (tells) Object.assign(known, { called_for: decision.called_for, change_jnd: decision.change_jnd, reason: decision.reason });
  }
  return [...effects.values()];
}

export class Effects extends EventTarget {
  #list;
  #total;
  #note;
  #output;
  #rows = new Map();
  #wishes = {};

  /** `root` is the section. Emits "wished" with the changed {effects, output}: on, off, or null to follow the plan. */
  constructor(root) {
    super();
    const find = (id) => root.querySelector(`#${id}`);
    this.#list = find("effects");
    this.#total = find("effects-cost");
    this.#note = find("effects-note");
    this.#output = find("output");
    this.#output.addEventListener("change", () => this.#wish({}, this.#output.value));
    this.rest();
  }

  /** Takes what was switched before, and the output, without an event. */
  restore({ effects, output }) {
    this.#wishes = { ...effects };
    if (output !== undefined && [...this.#output.options].some(({ value }) => value === output)) this.#output.value = output;
  }

  /** Switches effects on, off, or to what the plan says (null), as if by hand. */
  wish(effects) {
    this.#wish(effects);
  }

  /** Effects for a hello: only those that the user switched. */
  get wishes() {
    return { effects: { ...this.#wishes }, output: this.#output.value };
  }

  /** Shows a plan from the server. */
  show({ decisions, cost_us: cost, saved_us: saved }) {
    const effects = summarise(decisions);
    const on = effects.filter((effect) => effect.called_for).length;
    this.#total.textContent = `${on} of ${effects.length}`;
    this.#note.textContent = cost + saved > 0 ? `${microseconds(cost)} a block, ${microseconds(saved)} saved` : "on";
    for (const effect of effects) this.#row(effect.name).show(effect);
  }

  /** Shows that no stream is open. */
  rest() {
    this.#total.textContent = "–";
    this.#note.textContent = "once playing";
    for (const row of this.#rows.values()) row.rest();
  }

  /** Shows that everything is rendered in this browser, without a plan. */
  leave() {
    this.rest();
    this.#note.textContent = "all that the field has, in this browser";
  }

  #row(name) {
    if (!this.#rows.has(name)) {
      const row = new Row(name, (isOn) => this.#wish({ [name]: isOn }));
      this.#rows.set(name, row);
      this.#list.append(row.root);
    }
    return this.#rows.get(name);
  }

  #wish(effects, output = null) {
    for (const [name, isOn] of Object.entries(effects)) {
      if (isOn === null) delete this.#wishes[name];
      else this.#wishes[name] = isOn;
    }
    this.dispatchEvent(new CustomEvent("wished", { detail: { effects, output } }));
  }
}

class Row {
  #switch = element("input", "");
  #bar = element("i", "");
  #cost = element("span", "cost");
  #reason = element("p", "reason");
  #undo = element("button", "undo", "as planned");

  constructor(name, wish) {
    this.root = element("li", "effect");
    this.root.dataset.effect = name;
    this.#switch.type = "checkbox";
    this.#switch.setAttribute("role", "switch");
    this.#undo.type = "button";
    const label = element("label", "");
    label.append(this.#switch, element("span", "name", titleOf(name)));
    const track = element("span", "jnd");
    track.append(this.#bar);
    this.root.append(label, track, this.#cost, this.#reason, this.#undo);
    this.#switch.addEventListener("change", () => wish(this.#switch.checked));
    this.#undo.addEventListener("click", () => wish(null));
  }

  show({ called_for: isOn, change_jnd: change, cost_us: cost, reason, overridden, count, on }) {
    this.#switch.disabled = false;
    this.#switch.checked = isOn;
    this.root.classList.toggle("on", isOn);
    this.root.classList.toggle("overridden", overridden);
    this.#bar.style.transform = `scaleX(${Math.min(1, change / SHOWN_JND).toFixed(3)})`;
    this.#cost.textContent = cost === null || cost < 0.05 ? "" : microseconds(cost);
    this.#reason.textContent = unbroken(on > 0 && on < count ? `${reason} (${on} of ${count} sources)` : reason);
    this.#undo.hidden = !overridden;
  }

  rest() {
    this.#switch.disabled = true;
    this.root.classList.remove("on");
    this.#bar.style.transform = "scaleX(0)";
    this.#cost.textContent = "";
    this.#reason.textContent = "–";
    this.#undo.hidden = true;
  }
}
