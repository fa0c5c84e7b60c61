// Reloads the page with the same camera and controls.

import { element } from "./elements.js";

const STORAGE_KEY = "octex";
const CONTROLS = ["mode", "filter", "level", "relief", "footprints", "facing", "cubes", "turntable", "compare"];

let camera = null; // of the page, once all data is loaded

export function rememberCamera(current) {
  camera = current;
}

// The state of a control; null for a slider at its maximum, which another texture may change.
const stateOf = ({ type, checked, value, max }) => (type === "checkbox" ? checked : value === max ? null : value);

export function reload() {
  const controls = Object.fromEntries(CONTROLS.map((id) => [id, stateOf(element(id))]));
  if (camera) sessionStorage.setItem(STORAGE_KEY, JSON.stringify({ camera: camera.state, controls }));
  location.reload();
}

// The state before the last reload, or null. It stays stored until `restoreControls`, in case the page reloads again.
export const savedState = () => JSON.parse(sessionStorage.getItem(STORAGE_KEY));

export function restoreControls(controls) {
  sessionStorage.removeItem(STORAGE_KEY);
  for (const [id, value] of Object.entries(controls)) {
    const control = element(id), isOffered = !control.options || [...control.options].some((option) => option.value === value);
    if (value === null || !isOffered || control.disabled) continue;
    control[control.type === "checkbox" ? "checked" : "value"] = value;
    control.dispatchEvent(new Event("input"));
  }
}
