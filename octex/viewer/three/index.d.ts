import type { BufferGeometry, Group, Loader, Material, Mesh, MeshStandardMaterial, Object3D } from "three";

export type Filter = "nearest" | "linear" | "quadratic";

/** An octree texture, which materials look up by rest positions. */
export class OctreeTexture {
  /** Depth, origin and size of the root cell, channels. */
  readonly header: { depth: number; origin: [number, number, number]; size: number; channels: { name: string; components: number }[] };
  /** Its mesh, if the file has one. */
  readonly mesh: Mesh<BufferGeometry, MeshStandardMaterial> | null;
  /** The filter between cells. Default: "quadratic". */
  filter: Filter;
  /** The finest level that is looked up. Default: all levels. */
  level: number;
  /** Whether lookups average over a pixel's footprint. Default: true. */
  footprints: boolean;
  /** Replace a material's own maps and values by the channels of this texture; returns the material. */
  applyTo<T extends Material>(material: T): T;
  /** Give the meshes of an object rest positions, as it stands now, and materials of this texture; by default clones of its own. */
  applyToObject(object: Object3D, material?: (own: Material) => Material): void;
  dispose(): void;
}

/** The content of a web file. */
export interface Loaded {
  textures: OctreeTexture[];
  /** The meshes of the textures; null if the file has none. */
  group: Group | null;
  /** Resolves when the finest levels are loaded. */
  complete: Promise<void>;
}

/** Loads web files, NAME.octw, coarse levels first. */
export class OctreeTextureLoader extends Loader<Loaded> {
  /** Load a web file from memory. */
  parseBuffer(buffer: ArrayBuffer, name?: string): Promise<Loaded>;
}

/** EXT_octree_texture for GLTFLoader: `loader.register((parser) => new GLTFOctreeTexture(parser))`. */
export class GLTFOctreeTexture {
  readonly name: "EXT_octree_texture";
  constructor(parser: object);
  /** Textures the primitives that have the extension, and sets `octrees` of the glTF. */
  afterRoot(gltf: object): Promise<void>;
}

/** An entry of `octrees` of a loaded glTF. */
export interface GLTFOctree {
  texture: OctreeTexture;
  /** Resolves when the finest levels are loaded. */
  complete: Promise<void>;
}
