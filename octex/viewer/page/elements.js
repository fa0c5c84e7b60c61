// Finds and makes elements of the page, and downloads files.

const SVG = "http://www.w3.org/2000/svg", SVG_NAMES = ["svg", "path"];

export const element = (id) => document.getElementById(id);

// Make an element. An attribute "onNAME" is a listener; true stands for an empty attribute, false and null for none.
export function make(name, attributes = {}, ...children) {
  const made = SVG_NAMES.includes(name) ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "style") made.style.cssText = value; // the page's policy forbids the attribute
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

// A swatch of a CSS colour.
export const swatch = (color) => make("span", { class: "swatch", style: `background: ${color}` });

export function download(name, blob) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
