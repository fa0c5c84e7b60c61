// EXT_octree_texture for GLTFLoader: models that carry their octree.

import { BufferAttribute, BufferGeometry, LoaderUtils } from "three";
import { OctreeTextureLoader } from "./loader.js";

const NAME = "EXT_octree_texture";

export class GLTFOctreeTexture {
  // For `loader.register((parser) => new GLTFOctreeTexture(parser))`. The loaded glTF then has `octrees`: of each web file
  // its `texture`, and `complete`, which resolves when the finest levels are there.
  constructor(parser) {
    Object.assign(this, { name: NAME, parser });
  }

  async afterRoot(gltf) {
    const { json, associations } = this.parser, files = json.extensions?.[NAME]?.octrees ?? [];
    gltf.octrees = await Promise.all(files.map((file) => this.read(file)));
    const meshes = new Set();
    for (const scene of gltf.scenes) scene.traverse((mesh) => mesh.isMesh && meshes.add(mesh));
    const taken = new Map(); // the geometries and materials of primitives
    for (const mesh of meshes) {
      const { meshes: number, primitives = 0 } = associations.get(mesh) ?? {};
      const rest = json.meshes?.[number]?.primitives[primitives].extensions?.[NAME];
      if (!rest) continue;
      const { texture } = gltf.octrees[rest.octree], key = `${number} ${primitives}`;
      if (!taken.has(key)) taken.set(key, [await this.atRest(mesh.geometry, rest), texture.applyTo(mesh.material.clone())]);
      [mesh.geometry, mesh.material] = taken.get(key);
    }
  }

  async read({ uri, bufferView }) {
    const { options } = this.parser, loader = new OctreeTextureLoader(options.manager);
    const headers = options.requestHeader, credentials = options.crossOrigin === "use-credentials" ? "include" : "same-origin";
    const url = uri && LoaderUtils.resolveURL(uri, options.path);
    const given = uri
      ? { name: url, url: new URL(url, location.href).href, options: { headers, credentials } }
      : { name: NAME, buffer: await this.parser.getDependency("bufferView", bufferView) };
    const { textures: [texture], complete } = await loader.parse(given);
    return { texture, complete };
  }

  // Give a primitive its places in the root cell, and its normals there.
  async atRest(geometry, { rest, scale = 1, offset = [0, 0, 0] }) {
    const own = rest === undefined ? geometry : new BufferGeometry().setIndex(geometry.index);
    if (rest !== undefined) own.setAttribute("position", await this.parser.getDependency("accessor", rest));
    const { position } = own.attributes, places = new Float32Array(3 * position.count);
    if (!own.attributes.normal) own.computeVertexNormals();
    for (let n = 0; n < position.count; n++) {
      for (let axis = 0; axis < 3; axis++) places[3 * n + axis] = position.getComponent(n, axis) * scale + offset[axis];
    }
    geometry.setAttribute("octexRest", new BufferAttribute(places, 3));
    geometry.setAttribute("octexNormal", own.attributes.normal);
    return geometry;
  }
}
