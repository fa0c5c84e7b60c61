// An octree texture: its data textures, and the shader code by which materials of three.js look it up.

import {
  BufferAttribute, BufferGeometry, DataArrayTexture, DataTexture, Matrix3, Matrix4, Mesh, MeshStandardMaterial,
  NearestFilter, NoColorSpace, RGBAFormat, RGIntegerFormat, SRGBColorSpace, UnsignedByteType, UnsignedIntType, Vector3,
} from "three";
import { planeDefines, withEachPlane, channelSum, walkDefines, walkUniforms } from "../page/walk.js";
import { Octree, ROW } from "../page/octree.js";

const FILTERS = ["nearest", "linear", "quadratic"];
// Code to insert into fragment shaders of three.js: after which chunk, for which channel, and the code.
const INSERTIONS = [
  ["map_fragment", "BASE_COLOR", "diffuseColor.rgb *= BASE_COLOR;"],
  ["roughnessmap_fragment", "ROUGHNESS", "roughnessFactor *= ROUGHNESS;"],
  ["metalnessmap_fragment", "METALLIC", "metalnessFactor *= METALLIC;"],
  ["emissivemap_fragment", "EMISSIVE", "totalEmissiveRadiance += EMISSIVE;"],
  ["aomap_fragment", "OCCLUSION", "reflectedLight.indirectDiffuse *= OCCLUSION; reflectedLight.indirectSpecular *= OCCLUSION;"],
];
// A material's own map and value of each channel, and the value that leaves the channel as it is.
const MATERIAL_FIELDS = {
  base_color: ["map", "color", "#ffffff"], roughness: ["roughnessMap", "roughness", 1], metallic: ["metalnessMap", "metalness", 1],
  emissive: ["emissiveMap", "emissive", "#000000"], occlusion: ["aoMap"], normal: ["normalMap"],
};
// Channels of materials with light only.
const LIT = ["roughness", "metallic", "emissive", "occlusion", "normal"];
const NORMAL = "normal = shownNormal(2.0 * (NORMAL) - 1.0, octexSide, vOctexRest, -vViewPosition, normal);";
const VARYINGS = "varying vec3 vOctexRest;\nvarying vec3 vOctexNormal;\nvarying float vOctexMirror;\n";
const VERTEX_HEAD = `attribute vec3 octexRest;\nattribute vec3 octexNormal;\n${VARYINGS}`;
const VERTEX = `
vOctexRest = octexRest;
vOctexNormal = octexNormal;
vOctexMirror = sign(determinant(mat3(modelMatrix)));
#ifdef USE_INSTANCING
vOctexMirror *= sign(determinant(mat3(instanceMatrix)));
#endif
`;
// Finds the normal at rest of the visible side, then looks the texture up.
const LOOKUP = `
vec3 octexSide = vOctexMirror * cross(dFdx(vOctexRest), dFdy(vOctexRest));
octexSide = dot(octexSide, vOctexNormal) < 0.0 ? -vOctexNormal : vOctexNormal;
octexSide /= max(length(octexSide), 1e-20);
#ifdef FACING
face(octexSide);
#endif
lookUp(vOctexRest, u_footprints ? footprint(vOctexRest) : 0.0);
diffuseColor.a *= g_alpha;
`;

export class Shaders {
  // Read walk.glsl and what it needs, once.
  static read() {
    const text = async (name) => {
      const response = await fetch(new URL(`../page/shaders/${name}`, import.meta.url));
      if (!response.ok) throw new Error(`octex-three: ${response.url}: ${response.status}; serve the package's page folder too`);
      return response.text();
    };
    this.texts ??= Promise.all(["directions.glsl", "walk.glsl"].map(text)).then((texts) => texts.join("\n"));
    this.texts.catch(() => (this.texts = null));
    return this.texts;
  }
}

export class OctreeTexture {
  constructor(header, walk) {
    this.header = header;
    this.walk = walk;
    this.octree = new Octree(header);
    this.mesh = null;
    this.materials = new Set();
    this.uniforms = { u_footprints: { value: true } };
    const { octree } = this, { planes } = header;
    this.stores = [["u_nodes", () => [octree.words], RGIntegerFormat, 2], ["u_entries", () => [octree.entries], RGIntegerFormat, 2]];
    const layered = (name, isSrgb) => [name, () => octree.planes.filter((_, n) => planes[n] === isSrgb), RGBAFormat, 4, isSrgb];
    this.stores.push(layered("u_srgb", true), layered("u_linear", false));
    for (const [name, read, format, size, isSrgb] of this.stores) {
      if (read().length) this.uniforms[name] = { value: this.texture(read(), format, size, isSrgb) };
    }
    this.filter = "quadratic";
  }

  texture(arrays, format, size, isSrgb) {
    const isWords = format === RGIntegerFormat, rows = arrays[0].length / size / ROW;
    const whole = isWords ? arrays[0] : new Uint8Array(arrays.length * arrays[0].length);
    const made = isWords ? new DataTexture(whole, ROW, rows, format, UnsignedIntType) : new DataArrayTexture(whole, ROW, rows, arrays.length);
    if (isWords) made.internalFormat = "RG32UI"; // three before 0.170 does not find it
    else Object.assign(made, { type: UnsignedByteType, colorSpace: isSrgb ? SRGBColorSpace : NoColorSpace });
    Object.assign(made, { magFilter: NearestFilter, minFilter: NearestFilter, generateMipmaps: false, unpackAlignment: 1 });
    return made;
  }

  channel(name) {
    return this.header.channels.find((channel) => channel.name === name);
  }

  // Set the rows of a chunk, see Octree.copyRows.
  setRows(rows) {
    this.octree.setRows(rows);
    for (const [name, read, format] of this.stores) {
      const arrays = read();
      if (!arrays.length) continue;
      const { value } = this.uniforms[name];
      if (format !== RGIntegerFormat) arrays.forEach((array, layer) => value.image.data.set(array, layer * array.length));
      value.needsUpdate = true;
    }
    this.update();
  }

  get filter() {
    return this.options.filter;
  }

  // "nearest", "linear" or "quadratic".
  set filter(filter) {
    if (!FILTERS.includes(filter)) throw new Error(`filter must be one of ${FILTERS.join(", ")}, not ${filter}`);
    this.options = { ...this.options, filter };
    for (const material of this.materials) material.needsUpdate = true; // each filter has its own program
    this.update();
  }

  get level() {
    return this.options.level ?? this.header.depth;
  }

  // The finest level that is looked up.
  set level(level) {
    this.options = { ...this.options, level };
    this.update();
  }

  get footprints() {
    return this.uniforms.u_footprints.value;
  }

  // Whether lookups average over a pixel's footprint.
  set footprints(isOn) {
    this.uniforms.u_footprints.value = isOn;
  }

  update() {
    for (const [name, value] of Object.entries(walkUniforms(this.octree, this.level))) {
      (this.uniforms[name] ??= { value: null }).value = Array.isArray(value) ? new Vector3(...value) : value;
    }
  }

  // Replace a material's own maps and values by the channels of this texture; returns the material.
  applyTo(material) {
    if (this.materials.has(material)) return material;
    const before = material.onBeforeCompile, key = material.customProgramCacheKey, names = this.clearFields(material);
    const defines = () => this.defines(names).join("\n");
    material.onBeforeCompile = (shader, renderer) => {
      before.call(material, shader, renderer);
      Object.assign(shader.uniforms, this.uniforms);
      this.checkSize(renderer.capabilities.maxTextureSize);
      this.compile(shader, names, defines());
    };
    material.customProgramCacheKey = () => `${key.call(material)} ${defines()}`;
    material.needsUpdate = true;
    this.materials.add(material);
    return material;
  }

  // Clear a material's own maps and values of the texture's channels; returns the names of these channels.
  clearFields(material) {
    const isLit = !material.isMeshBasicMaterial && !material.isMeshBasicNodeMaterial;
    const names = Object.keys(MATERIAL_FIELDS).filter((name) => this.channel(name) && (isLit || !LIT.includes(name)));
    if (names.includes("base_color")) material.vertexColors = false;
    for (const name of names) {
      const [map, value, plain] = MATERIAL_FIELDS[name];
      if (map in material) material[map] = null;
      if (material[value]?.isColor) material[value].set(plain);
      else if (value in material) material[value] = plain;
    }
    if (this.channel("alpha")) material.transparent = true;
    return names;
  }

  // Throw an error if the GPU's largest textures are too small.
  checkSize(maxSize) {
    const rows = Math.max(...this.octree.planes.map((plane) => plane.length / 4 / ROW));
    if (Math.max(rows, ROW) > maxSize) throw new Error(`this GPU has textures of ${maxSize}, and the octree needs ${Math.max(rows, ROW)}: write the file with a --max-size`);
  }

  // The defines of the shaders that look up channels.
  defines(names) {
    const read = [...names, "alpha"].map((name) => this.channel(name)).filter(Boolean).map(({ at: [plane] }) => plane);
    const { header } = this, isFacing = header.split[0] > 0;
    if (isFacing || header.kept) read.push(header.flags[0]);
    const planes = Math.max(0, ...read) + 1;
    return [...planeDefines(header, planes), ...walkDefines(header, isFacing, this.filter), ...names.map((name) => `#define ${name.toUpperCase()} ${channelSum(this.channel(name))}`)];
  }

  compile(shader, names, defines) {
    const planes = Number(/PLANES (\d+)/.exec(defines)[1]);
    shader.vertexShader = VERTEX_HEAD + shader.vertexShader.replace("#include <begin_vertex>", `$&${VERTEX}`);
    let text = shader.fragmentShader.replace("#include <map_fragment>", `${LOOKUP}$&`);
    for (const [chunk, name, then] of INSERTIONS) {
      if (defines.includes(`#define ${name} `)) text = text.replace(`#include <${chunk}>`, `$&\n${then}`);
    }
    if (names.includes("normal")) text = text.replace("#include <normal_fragment_maps>", `$&${NORMAL}`);
    shader.fragmentShader = [defines, VARYINGS, "uniform bool u_footprints;", withEachPlane(this.walk, planes), text].join("\n");
  }

  // Give the meshes of an object, such as a scene of GLTFLoader, rest positions and materials of this texture. The object must
  // stand as it does in its file. Geometries that meshes share are copied. `material` makes a material from a mesh's own.
  applyToObject(object, material = (own) => own.clone()) {
    object.updateMatrixWorld(true);
    const toRoot = object.parent ? new Matrix4().copy(object.matrixWorld).multiply(new Matrix4().copy(object.matrix).invert()).invert() : new Matrix4();
    const geometries = new Set();
    object.traverse((mesh) => {
      if (!mesh.isMesh) return;
      if (geometries.has(mesh.geometry)) mesh.geometry = mesh.geometry.clone();
      geometries.add(mesh.geometry);
      this.addRest(mesh, toRoot);
      mesh.material = Array.isArray(mesh.material) ? mesh.material.map((each) => this.applyTo(material(each))) : this.applyTo(material(mesh.material));
    });
  }

  // Add the attributes of rest positions in the root cell, and of normals at rest, from a mesh as it stands now.
  addRest(mesh, toRoot) {
    const { geometry } = mesh, { position, normal } = geometry.attributes, { origin, size } = this.header;
    const positions = new Float32Array(3 * position.count), normals = new Float32Array(3 * position.count), vector = new Vector3();
    const matrix = new Matrix4().multiplyMatrices(toRoot, mesh.matrixWorld), low = new Vector3(...origin);
    const normalMatrix = new Matrix3().getNormalMatrix(matrix);
    if (!normal) geometry.computeVertexNormals();
    for (let n = 0; n < position.count; n++) {
      mesh.getVertexPosition(n, vector).applyMatrix4(matrix).sub(low).divideScalar(size).toArray(positions, 3 * n);
      vector.fromBufferAttribute(geometry.attributes.normal, n).applyNormalMatrix(normalMatrix).toArray(normals, 3 * n);
    }
    geometry.setAttribute("octexRest", new BufferAttribute(positions, 3));
    geometry.setAttribute("octexNormal", new BufferAttribute(normals, 3));
  }

  setMesh(mesh) {
    const geometry = new BufferGeometry();
    const attributes = { position: mesh.positions, normal: mesh.normals, octexRest: mesh.rest, octexNormal: mesh.restNormals ?? mesh.normals };
    for (const [name, array] of Object.entries(attributes)) geometry.setAttribute(name, new BufferAttribute(array, 3));
    geometry.setIndex(new BufferAttribute(mesh.triangles, 1));
    const material = new MeshStandardMaterial({ roughness: 1, metalness: this.channel("metallic") ? 1 : 0 });
    this.mesh = new Mesh(geometry, this.applyTo(material));
    this.mesh.name = this.header.name;
  }

  dispose() {
    for (const { value } of Object.values(this.uniforms)) value?.dispose?.();
    this.mesh?.geometry.dispose();
    this.materials.clear();
  }
}
