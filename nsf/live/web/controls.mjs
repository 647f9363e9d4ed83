// Controls and texts of the pages. What a page was given is shown as text, never as markup.

import { quantity } from "./trust.mjs";

/** @typedef {{ title: string, unit: string, top: number, low?: number, names?: string[] }} Quantity names: of categories, in place of a scale */
/** @typedef {{ name: string, unit: string, lower: number, upper: number, step: number, trained: number[] }} Parameter */

const PREFIXES = /** @type {[number, string][]} */ ([[1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"]]);
const LABELS = 5; // below a scale of colours

/**
 * The element with an id, which the page has.
 * @param {string} id
 * @returns {any}
 */
export function find(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no ${id}`);
  return found;
}

/**
 * A new element.
 * @param {string} kind
 * @param {Record<string, any>} properties
 * @param {(Node | string)[]} children
 * @returns {any}
 */
export function element(kind, properties = {}, ...children) {
  const made = Object.assign(document.createElement(kind), properties);
  made.append(...children);
  return made;
}

/** A button. @param {string} id @param {string} text @param {() => void} act @param {string} [title] */
export function button(id, text, act, title = "") {
  return element("button", { id, type: "button", textContent: text, title, onclick: act });
}

/**
 * A labelled choice.
 * @param {string} id
 * @param {string} label
 * @param {[string, string][]} options value and text of each
 * @param {string} value
 * @param {(value: string) => void} act
 */
export function choice(id, label, options, value, act) {
  const made = options.map(([own, text]) => element("option", { value: own, textContent: text }));
  const select = element("select", { id, onchange: () => act(select.value) }, ...made);
  select.value = value;
  return element("label", { className: "row" }, label, select);
}

/** A labelled tick. @param {string} id @param {string} label @param {(on: boolean) => void} act */
export function tick(id, label, act) {
  const box = element("input", { id, type: "checkbox", onchange: () => act(box.checked) });
  return element("label", {}, box, ` ${label}`);
}

/**
 * A slider of a problem parameter, with its value and its training range beside it.
 * @param {Parameter} parameter
 * @param {number} value
 * @param {(value: number) => void} act
 */
export function slider({ name, unit, lower, upper, step, trained }, value, act) {
  const input = element("input", { type: "range", min: lower, max: upper, step: "any", ariaLabel: name });
  const shown = element("output");
  const show = (/** @type {number} */ now) => {
    input.value = now;
    shown.textContent = valued(now, unit, step);
    input.setAttribute("aria-valuetext", shown.textContent);
  };
  input.oninput = () => {
    show(Number(input.value));
    act(Number(input.value));
  };
  // As step is "any", keys would go by a whole number.
  input.onkeydown = (/** @type {KeyboardEvent} */ event) => {
    const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 }[event.key];
    if (!way) return;
    event.preventDefault();
    input.value = Number(input.value) + way * step;
    input.oninput();
  };
  const range = trained.map((end) => quantity(end, unit, 4)).join(" to ");
  const row = element("div", { className: "row" }, element("span", { textContent: name }), shown);
  const made = element("div", { className: "slider" }, row, input, element("small", {}, `trained: ${range}`));
  show(value);
  return { made, input, show };
}

/**
 * The sliders of problem parameters.
 * @param {Parameter[]} parameters
 * @param {number[]} values
 * @param {(values: number[]) => void} act with the values of all
 */
export function sliders(parameters, values, act) {
  /** @type {{ made: any, input: any, show: (value: number) => void }[]} */
  const made = parameters.map((p, i) => slider(p, values[i], () => act(made.map((own) => Number(own.input.value)))));
  return made;
}

/**
 * A value with as many digits as the steps of its slider tell apart.
 * @param {number} value
 * @param {string} unit
 * @param {number} step
 */
export function valued(value, unit, step) {
  const digits = Math.min(12, Math.max(0, 1 - Math.floor(Math.log10(step))));
  const shown = value.toFixed(digits);
  if (unit === "°") return `${shown}°`;
  return ["", "-", "1"].includes(unit) ? shown : `${shown} ${unit}`;
}

/**
 * A value with a prefix of its unit.
 * @param {number} value
 * @param {string} unit
 */
export function prefixed(value, unit) {
  const { factor, prefix } = prefixOf(value);
  return `${Number((value / factor).toPrecision(3))} ${prefix}${unit}`;
}

/** The prefix in which a value is no less than 0.3, and its factor. @param {number} value */
function prefixOf(value) {
  const [factor, prefix] = PREFIXES.find(([own]) => value >= 0.3 * own) ?? PREFIXES[PREFIXES.length - 1];
  return { factor, prefix };
}

/** How many points are shown. @param {number} points @param {number} particles of the model */
export function counted(points, particles) {
  const [shown, all] = [points, particles].map((n) => n.toLocaleString("en"));
  return points > particles ? `${shown} points` : points === particles ? `${all} particles` : `${shown} of ${all} particles`;
}

/**
 * Show the scale of colours of a quantity.
 * @param {Quantity} shown
 * @param {number[]} colors [256 × 3]
 */
export function legend({ title, unit, top, low = 0, names }, colors) {
  const stops = Array.from({ length: 16 }, (_, k) => `rgb(${colors.slice(51 * k, 51 * k + 3)})`);
  const bar = element("i");
  bar.style.background = `linear-gradient(to right, ${stops})`;
  const { factor, prefix } = prefixOf(top), digits = Math.max(0, 1 - Math.floor(Math.log10(top / factor)));
  const values = Array.from({ length: LABELS }, (_, k) => ((low + (k * (top - low)) / (LABELS - 1)) / factor).toFixed(digits));
  const ends = [low ? `≤ ${values[0]}` : "0", ...values.slice(1, -1), `≥ ${values[LABELS - 1]}`].map((text) => text.replace("-", "−"));
  const labels = element("div", { className: "row" }, ...(names ?? ends).map((text) => element("span", {}, text)));
  find("scale").replaceChildren(element("div", { textContent: names ? title : `${title} [${prefix}${unit}]` }), bar, labels);
}

/**
 * Show a light with its reason.
 * @param {import("./trust.mjs").Light} light
 */
export function lit({ level, text }) {
  const shown = find("light");
  if (shown.textContent === text) return;
  shown.textContent = text;
  shown.dataset.level = level;
}

/** Title and line below it. @param {string} title @param {string} line */
export function headed(title, line) {
  document.title = title;
  find("title").textContent = title;
  find("line").textContent = line;
}

/** Say why nothing is shown. @param {unknown} fault */
export function fail(fault) {
  find("fault").textContent = fault instanceof Error ? fault.message : String(fault);
  document.body.dataset.ready = "false";
}

/**
 * Keys of the page, where no control has the focus that takes them itself.
 * @param {Record<string, () => void>} keys
 */
export function keyed(keys) {
  addEventListener("keydown", (event) => {
    const at = /** @type {HTMLElement} */ (event.target);
    if (at.matches?.("select, input, button") || event.ctrlKey || event.metaKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
}

/** Let the browser keep a file. @param {string} name @param {Blob} content */
export function download(name, content) {
  const link = element("a", { href: URL.createObjectURL(content), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** Call `act` when the window, or its colours, change. @param {() => void} act */
export function onLook(act) {
  addEventListener("resize", act);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", act);
}
