// The glTF extension EXT_octree_texture for GLTFLoader: models that contain their octree.

import { BufferAttribute, BufferGeometry, LoaderUtils } from "three";
import { OctreeTextureLoader } from "./loader.js";

const NAME = "EXT_octree_texture";

export class GLTFOctreeTexture {
  // Register it with `loader.register((parser) => new GLTFOctreeTexture(parser))`. The loaded glTF then has `octrees`: for
  // each web file its `texture`, and `complete`, a promise that resolves when the finest levels are loaded.
  constructor(parser) {
    Object.assign(this, { name: NAME, parser });
  }

  async afterRoot(gltf) {
    const { json, associations } = this.parser, files = json.extensions?.[NAME]?.octrees ?? [];
    gltf.octrees = await Promise.all(files.map((file) => this.read(file)));
    const meshes = new Set();
    for (const scene of gltf.scenes) scene.traverse((mesh) => mesh.isMesh && meshes.add(mesh));
    const done = new Map(); // by primitive: its geometry and material
    for (const mesh of meshes) {
      const { meshes: number, primitives = 0 } = associations.get(mesh) ?? {};
      const rest = json.meshes?.[number]?.primitives[primitives].extensions?.[NAME];
      if (!rest) continue;
      const { texture } = gltf.octrees[rest.octree], key = `${number} ${primitives}`;
      if (!done.has(key)) done.set(key, [await this.withRest(mesh.geometry, rest), texture.applyTo(mesh.material.clone())]);
      [mesh.geometry, mesh.material] = done.get(key);
    }
  }

  async read({ uri, bufferView }) {
    const { options } = this.parser, loader = new OctreeTextureLoader(options.manager);
    const headers = options.requestHeader, credentials = options.crossOrigin === "use-credentials" ? "include" : "same-origin";
    const url = uri && LoaderUtils.resolveURL(uri, options.path);
    const source = uri
      ? { name: url, url: new URL(url, location.href).href, options: { headers, credentials } }
      : { name: NAME, buffer: await this.parser.getDependency("bufferView", bufferView) };
    const { textures: [texture], complete } = await loader.parse(source);
    return { texture, complete };
  }

  // Give a geometry the attributes of rest positions in the root cell, and of normals at rest.
  async withRest(geometry, { rest, scale = 1, offset = [0, 0, 0] }) {
    const atRest = rest === undefined ? geometry : new BufferGeometry().setIndex(geometry.index);
    if (rest !== undefined) atRest.setAttribute("position", await this.parser.getDependency("accessor", rest));
    const { position } = atRest.attributes, positions = new Float32Array(3 * position.count);
    if (!atRest.attributes.normal) atRest.computeVertexNormals();
    for (let n = 0; n < position.count; n++) {
      for (let axis = 0; axis < 3; axis++) positions[3 * n + axis] = position.getComponent(n, axis) * scale + offset[axis];
    }
    geometry.setAttribute("octexRest", new BufferAttribute(positions, 3));
    geometry.setAttribute("octexNormal", atRest.attributes.normal);
    return geometry;
  }
}
