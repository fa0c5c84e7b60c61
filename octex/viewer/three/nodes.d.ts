import type { Material } from "three";
import type { OctreeTexture } from "./index.js";

/**
 * For WebGPURenderer: replace a material's own maps and values by the channels of a texture with its current filter; returns
 * the material. Call it again after the filter has changed.
 */
export function applyNodes<T extends Material>(texture: OctreeTexture, material: T): T;
