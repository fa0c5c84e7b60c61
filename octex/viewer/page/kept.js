// What a page keeps when it loads all anew: the camera, and what its controls are set to.

import { element } from "./elements.js";

const NAME = "octex";
const CONTROLS = ["shown", "filter", "level", "relief", "footprints", "facing", "cubes", "turntable", "beside"];

const stateOf = ({ type, checked, value, max }) => (type === "checkbox" ? checked : value === max ? null : value);

let camera = null; // of the page, once all has come

export const keep = (own) => (camera = own);

export function reload() {
  const controls = Object.fromEntries(CONTROLS.map((id) => [id, stateOf(element(id))]));
  if (camera) sessionStorage.setItem(NAME, JSON.stringify({ camera: camera.state, controls }));
  location.reload();
}

// What was kept; null if all is new. It is kept until all has come.
export const kept = () => JSON.parse(sessionStorage.getItem(NAME));

export function restoreControls(controls) {
  sessionStorage.removeItem(NAME);
  for (const [id, value] of Object.entries(controls)) {
    const control = element(id), isOffered = !control.options || [...control.options].some((option) => option.value === value);
    if (value === null || !isOffered || control.disabled) continue;
    control[control.type === "checkbox" ? "checked" : "value"] = value;
    control.dispatchEvent(new Event("input"));
  }
}
