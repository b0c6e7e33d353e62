// Colours for canvases, read from the style sheet, so that both themes are defined in one place.

const STOPS = ["--map-0", "--map-1", "--map-2", "--map-3", "--map-4", "--map-5"];

function parse(hex) {
  const value = Number.parseInt(hex.trim().slice(1), 16);
  return [(value >> 16) & 255, (value >> 8) & 255, value & 255];
}

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** The loudness ramp of the current theme: fraction 0 (quiet) to 1 (loud) -> [r, g, b]. */
export function loudnessRamp() {
  const stops = STOPS.map((name) => parse(colour(name)));
  return (fraction) => {
    const at = Math.min(1, Math.max(0, fraction)) * (stops.length - 1);
    const low = Math.min(stops.length - 2, Math.floor(at));
    return stops[low].map((value, index) => Math.round(value + (at - low) * (stops[low + 1][index] - value)));
  };
}

/** Calls `changed` whenever the system switches between light and dark. */
export function onThemeChange(changed) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
}

const SOURCES = 8; // colours of the style sheet, --source-1 and on

/** CSS colour of a source by its id. Successive ids differ in colour. */
export const sourceColour = (id) => {
  const ordinal = [...id].reduce((sum, letter) => 26 * sum + letter.charCodeAt(0) - 64, 0);
  return `var(--source-${((ordinal - 1) % SOURCES) + 1})`;
};
