// Octree textures in three.js. See ../README.md.

export { OctreeTexture } from "./texture.js";
export { OctreeTextureLoader } from "./loader.js";
export { GLTFOctreeTexture } from "./gltf.js";
