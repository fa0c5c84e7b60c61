import type { Material } from "three";
import type { OctreeTexture } from "./index.js";

/**
 * For WebGPURenderer: have a material take its channels from a texture, with the filter that it has now, instead of its own
 * maps and values; returns the material. Call it again after the filter has changed.
 */
export function applyNodes<T extends Material>(texture: OctreeTexture, material: T): T;
