// An octree texture: what the GPU holds of it, and how materials of three.js look it up.

import {
  BufferAttribute, BufferGeometry, DataArrayTexture, DataTexture, Matrix3, Matrix4, Mesh, MeshStandardMaterial,
  NearestFilter, NoColorSpace, RGBAFormat, RGIntegerFormat, SRGBColorSpace, UnsignedByteType, UnsignedIntType, Vector3,
} from "three";
import { planeLines, repeated, sumOf, walkLines, walkUniforms } from "../page/field.js";
import { Octree, ROW } from "../page/octree.js";

const FILTERS = ["nearest", "linear", "quadratic"];
// Where materials of three.js take what is looked up: after which chunk, and what then is done.
const PLACES = [
  ["map_fragment", "BASE_COLOR", "diffuseColor.rgb *= BASE_COLOR;"],
  ["roughnessmap_fragment", "ROUGHNESS", "roughnessFactor *= ROUGHNESS;"],
  ["metalnessmap_fragment", "METALLIC", "metalnessFactor *= METALLIC;"],
  ["emissivemap_fragment", "EMISSIVE", "totalEmissiveRadiance += EMISSIVE;"],
  ["aomap_fragment", "OCCLUSION", "reflectedLight.indirectDiffuse *= OCCLUSION; reflectedLight.indirectSpecular *= OCCLUSION;"],
];
// What a material has of a channel itself: its map, its value, and what the value becomes.
const OWN = {
  base_color: ["map", "color", "#ffffff"], roughness: ["roughnessMap", "roughness", 1], metallic: ["metalnessMap", "metalness", 1],
  emissive: ["emissiveMap", "emissive", "#000000"], occlusion: ["aoMap"], normal: ["normalMap"],
};
// Materials without light have none of these.
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
// The side at rest that is looked at, then the look itself.
const LOOK = `
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
  // The walk and what it needs, read once.
  static read() {
    const text = async (name) => {
      const response = await fetch(new URL(`../page/shaders/${name}`, import.meta.url));
      if (!response.ok) throw new Error(`octex-three: ${response.url}: ${response.status}; serve the package's page folder too`);
      return response.text();
    };
    this.known ??= Promise.all(["directions.glsl", "walk.glsl"].map(text)).then((texts) => texts.join("\n"));
    this.known.catch(() => (this.known = null));
    return this.known;
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
    const layered = (name, is) => [name, () => octree.planes.filter((_, n) => planes[n] === is), RGBAFormat, 4, is];
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

  // Take rows of levels, or those of kept nodes and split cells.
  take(rows) {
    this.octree.takeRows(rows);
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
    return this.known.filter;
  }

  // "nearest", "linear" or "quadratic".
  set filter(filter) {
    if (!FILTERS.includes(filter)) throw new Error(`filter must be one of ${FILTERS.join(", ")}, not ${filter}`);
    this.known = { ...this.known, filter };
    for (const material of this.materials) material.needsUpdate = true; // programs differ
    this.update();
  }

  get level() {
    return this.known.level ?? this.header.depth;
  }

  // The deepest level that is looked up.
  set level(level) {
    this.known = { ...this.known, level };
    this.update();
  }

  get footprints() {
    return this.uniforms.u_footprints.value;
  }

  // Whether each pixel averages over what it covers.
  set footprints(is) {
    this.uniforms.u_footprints.value = is;
  }

  update() {
    for (const [name, value] of Object.entries(walkUniforms(this.octree, this.level))) {
      (this.uniforms[name] ??= { value: null }).value = Array.isArray(value) ? new Vector3(...value) : value;
    }
  }

  // Have a material take its channels from this texture instead of its own maps and values; returns the material.
  applyTo(material) {
    if (this.materials.has(material)) return material;
    const before = material.onBeforeCompile, key = material.customProgramCacheKey, names = this.claim(material);
    const defines = () => this.lines(names).join("\n");
    material.onBeforeCompile = (shader, renderer) => {
      before.call(material, shader, renderer);
      Object.assign(shader.uniforms, this.uniforms);
      this.check(renderer.capabilities.maxTextureSize);
      this.compile(shader, names, defines());
    };
    material.customProgramCacheKey = () => `${key.call(material)} ${defines()}`;
    material.needsUpdate = true;
    this.materials.add(material);
    return material;
  }

  // Take away what a material has of the texture's channels itself; returns their names.
  claim(material) {
    const isLit = !material.isMeshBasicMaterial && !material.isMeshBasicNodeMaterial;
    const names = Object.keys(OWN).filter((name) => this.channel(name) && (isLit || !LIT.includes(name)));
    if (names.includes("base_color")) material.vertexColors = false;
    for (const name of names) {
      const [map, value, plain] = OWN[name];
      if (map in material) material[map] = null;
      if (material[value]?.isColor) material[value].set(plain);
      else if (value in material) material[value] = plain;
    }
    if (this.channel("alpha")) material.transparent = true;
    return names;
  }

  // Refuse a GPU whose textures are too small.
  check(most) {
    const rows = Math.max(...this.octree.planes.map((plane) => plane.length / 4 / ROW));
    if (Math.max(rows, ROW) > most) throw new Error(`this GPU has textures of ${most}, and the octree needs ${Math.max(rows, ROW)}: write the file with a --max-size`);
  }

  lines(names) {
    const read = [...names, "alpha"].map((name) => this.channel(name)).filter(Boolean).map(({ at: [plane] }) => plane);
    const { header } = this, isFacing = header.split[0] > 0;
    if (isFacing || header.kept) read.push(header.flags[0]);
    const planes = Math.max(0, ...read) + 1;
    return [...planeLines(header, planes), ...walkLines(header, isFacing, this.filter), ...names.map((name) => `#define ${name.toUpperCase()} ${sumOf(this.channel(name))}`)];
  }

  compile(shader, names, defines) {
    const planes = Number(/PLANES (\d+)/.exec(defines)[1]);
    shader.vertexShader = VERTEX_HEAD + shader.vertexShader.replace("#include <begin_vertex>", `$&${VERTEX}`);
    let text = shader.fragmentShader.replace("#include <map_fragment>", `${LOOK}$&`);
    for (const [chunk, name, then] of PLACES) {
      if (defines.includes(`#define ${name} `)) text = text.replace(`#include <${chunk}>`, `$&\n${then}`);
    }
    if (names.includes("normal")) text = text.replace("#include <normal_fragment_maps>", `$&${NORMAL}`);
    shader.fragmentShader = [defines, VARYINGS, "uniform bool u_footprints;", repeated(this.walk, planes), text].join("\n");
  }

  // Give the meshes of an object, such as a scene that GLTFLoader has read, positions at rest and materials of this texture.
  // The object stands as it does in its file. Geometries that several meshes share are copied.
  applyToObject(object, material = (own) => own.clone()) {
    object.updateMatrixWorld(true);
    const toRoot = object.parent ? new Matrix4().copy(object.matrixWorld).multiply(new Matrix4().copy(object.matrix).invert()).invert() : new Matrix4();
    const seen = new Set();
    object.traverse((mesh) => {
      if (!mesh.isMesh) return;
      if (seen.has(mesh.geometry)) mesh.geometry = mesh.geometry.clone();
      seen.add(mesh.geometry);
      this.rest(mesh, toRoot);
      mesh.material = Array.isArray(mesh.material) ? mesh.material.map((each) => this.applyTo(material(each))) : this.applyTo(material(mesh.material));
    });
  }

  // Store where a mesh rests in the root cell, as it stands now.
  rest(mesh, toRoot) {
    const { geometry } = mesh, { position, normal } = geometry.attributes, { origin, size } = this.header;
    const places = new Float32Array(3 * position.count), sides = new Float32Array(3 * position.count), at = new Vector3();
    const whole = new Matrix4().multiplyMatrices(toRoot, mesh.matrixWorld), low = new Vector3(...origin);
    const turn = new Matrix3().getNormalMatrix(whole);
    if (!normal) geometry.computeVertexNormals();
    for (let n = 0; n < position.count; n++) {
      mesh.getVertexPosition(n, at).applyMatrix4(whole).sub(low).divideScalar(size).toArray(places, 3 * n);
      at.fromBufferAttribute(geometry.attributes.normal, n).applyNormalMatrix(turn).toArray(sides, 3 * n);
    }
    geometry.setAttribute("octexRest", new BufferAttribute(places, 3));
    geometry.setAttribute("octexNormal", new BufferAttribute(sides, 3));
  }

  takeMesh(mesh) {
    const geometry = new BufferGeometry();
    const attributes = { position: mesh.positions, normal: mesh.normals, octexRest: mesh.rest, octexNormal: mesh.upright ?? mesh.normals };
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
