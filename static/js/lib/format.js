// Numbers as people read them. Metres and radians come in; mm, cm and degrees only go out.

const MINUS = "\u2212";
const DASH = "–";

/** A number with fixed decimals and a real minus sign; a dash where there is none. @param {number | null | undefined} value @param {number} [decimals] */
export function fixed(value, decimals = 2) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", MINUS);
}

/** @param {number | null | undefined} value_m @param {number} [decimals] */
export const metres = (value_m, decimals = 2) => withUnit(fixed(value_m, decimals), "m");
/** @param {number | null | undefined} value_m @param {number} [decimals] */
export const centimetres = (value_m, decimals = 1) => withUnit(fixed(scaled(value_m, 100), decimals), "cm");
/** @param {number | null | undefined} value_m @param {number} [decimals] */
export const millimetres = (value_m, decimals = 1) => withUnit(fixed(scaled(value_m, 1000), decimals), "mm");
/** @param {number | null | undefined} value_s @param {number} [decimals] */
export const seconds = (value_s, decimals = 2) => withUnit(fixed(value_s, decimals), "s");
/** @param {number | null | undefined} value_s @param {number} [decimals] */
export const milliseconds = (value_s, decimals = 1) => withUnit(fixed(scaled(value_s, 1000), decimals), "ms");
/** @param {number | null | undefined} value_px @param {number} [decimals] */
export const pixels = (value_px, decimals = 2) => withUnit(fixed(value_px, decimals), "px");
/** @param {number | null | undefined} value_deg @param {number} [decimals] */
export const degrees = (value_deg, decimals = 1) =>
  fixed(value_deg, decimals) === DASH ? DASH : `${fixed(value_deg, decimals)}°`;

/** Thousands apart: 12 345 678. @param {number | null | undefined} value */
export function count(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  return Math.round(value)
    .toString()
    .replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

/** Bytes as kB, MB, GB. @param {number | null | undefined} bytes */
export function size(bytes) {
  if (bytes === null || bytes === undefined) return DASH;
  const units = ["B", "kB", "MB", "GB", "TB"];
  let value = bytes;
  let step = 0;
  while (value >= 1000 && step < units.length - 1) {
    value /= 1000;
    step += 1;
  }
  return `${value.toFixed(step > 0 && value < 100 ? 1 : 0)} ${units[step]}`;
}

/** Seconds as "45 s", "3 min 20 s", "1 h 5 min". @param {number | null | undefined} seconds */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return DASH;
  const whole = Math.round(seconds);
  if (whole < 60) return seconds < 10 ? `${fixed(seconds, 1)} s` : `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
}

/** "just now", "12 min ago", or the date. @param {number} then_s seconds since 1970 @param {number} [now_s] */
export function ago(then_s, now_s = Date.now() / 1000) {
  const age = now_s - then_s;
  if (age < 60) return "just now";
  if (age < 3600) return `${Math.floor(age / 60)} min ago`;
  if (age < 86400) return `${Math.floor(age / 3600)} h ago`;
  return day(then_s);
}

/** "3 May 2026", as it is written here. @param {number} then_s seconds since 1970 */
export const day = (then_s) =>
  new Date(then_s * 1000).toLocaleDateString(undefined, { day: "numeric", month: "short", year: "numeric" });

/** "1 pair", "3 pairs". @param {number} n @param {string} one @param {string} [many] */
export const plural = (n, one, many = `${one}s`) => `${count(n)} ${n === 1 ? one : many}`;

/** @param {string} text @param {string} unit */
const withUnit = (text, unit) => (text === DASH ? DASH : `${text}\u202f${unit}`);
/** @param {number | null | undefined} value @param {number} factor */
const scaled = (value, factor) => (value === null || value === undefined ? null : value * factor);
