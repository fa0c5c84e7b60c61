// Ptex's own library, spoken to by ptex_peer.py: dumps .ptx files, and writes them of what it is given.
//
//     ptex_peer dump FILE.ptx > DUMP      all that the library says of a file
//     ptex_peer write FILE.ptx < CONTENTS
//
// Contents, in 32-bit integers and raw bytes: mesh type, data type, alpha channel, channels, faces, border modes
// of u and v, edge filter; of each face log2 of its sides, whether it is a subface, four neighbours and their
// edges; the texels of all faces, interleaved; how many entries of metadata, and of each its type, the bytes of
// its key and of its value, and these. A dump is the same with, after the texels, each face's constant (a
// pixel), whether it is flagged as one, and its reductions along both axes down to a pixel.

#include <Ptexture.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

static void put(const void* data, size_t size) {
    if (size && fwrite(data, size, 1, stdout) != 1) exit(3);
}
static void put(int32_t number) { put(&number, 4); }
static std::vector<char> take(size_t size) {
    std::vector<char> data(size + 1);
    if (size && fread(data.data(), size, 1, stdin) != 1) exit(3);
    return data;
}
static int32_t take() {
    int32_t number;
    memcpy(&number, take(4).data(), 4);
    return number;
}
static int fail(const char* what, const Ptex::String& why) {
    fprintf(stderr, "%s: %s\n", what, why.c_str());
    return 1;
}

static int dump(const char* path) {
    Ptex::String error;
    PtexPtr<PtexTexture> file(PtexTexture::open(path, error));
    if (!file) return fail(path, error);
    const size_t pixel = Ptex::DataSize(file->dataType()) * file->numChannels();
    put(file->meshType()), put(file->dataType()), put(file->alphaChannel()), put(file->numChannels());
    put(file->numFaces()), put(file->uBorderMode()), put(file->vBorderMode()), put(file->edgeFilterMode());
    for (int face = 0; face < file->numFaces(); face++) {
        const Ptex::FaceInfo& info = file->getFaceInfo(face);
        put(info.res.ulog2), put(info.res.vlog2), put(info.isSubface());
        for (int edge = 0; edge < 4; edge++) put(info.adjface(edge));
        for (int edge = 0; edge < 4; edge++) put(info.adjedge(edge));
    }
    std::vector<char> texels;
    for (int face = 0; face < file->numFaces(); face++) {
        texels.resize(pixel * file->getFaceInfo(face).res.size());
        file->getData(face, texels.data(), 0);
        put(texels.data(), texels.size());
    }
    for (int face = 0; face < file->numFaces(); face++) {
        Ptex::Res res = file->getFaceInfo(face).res;
        PtexPtr<PtexFaceData> least(file->getData(face, Ptex::Res(0, 0)));
        texels.resize(pixel);
        least->getPixel(0, 0, texels.data());
        put(texels.data(), pixel);
        put(file->getFaceInfo(face).isConstant());
        while (res.ulog2 > 0 && res.vlog2 > 0) {
            res.ulog2--, res.vlog2--;
            texels.resize(pixel * res.size());
            file->getData(face, texels.data(), 0, res);
            put(texels.data(), texels.size());
        }
    }
    PtexPtr<PtexMetaData> metadata(file->getMetaData());
    put(metadata->numKeys());
    for (int n = 0; n < metadata->numKeys(); n++) {
        const char* key;
        Ptex::MetaDataType type;
        metadata->getKey(n, key, type);
        const void* data = 0;
        int count = 0;
        size_t size = 0;
        const char* text;
        const int8_t* i8;
        const int16_t* i16;
        const int32_t* i32;
        const float* f32;
        const double* f64;
        switch (type) {
            case Ptex::mdt_string: metadata->getValue(n, text), data = text, size = strlen(text) + 1; break;
            case Ptex::mdt_int8: metadata->getValue(n, i8, count), data = i8, size = count; break;
            case Ptex::mdt_int16: metadata->getValue(n, i16, count), data = i16, size = 2 * count; break;
            case Ptex::mdt_int32: metadata->getValue(n, i32, count), data = i32, size = 4 * count; break;
            case Ptex::mdt_float: metadata->getValue(n, f32, count), data = f32, size = 4 * count; break;
            case Ptex::mdt_double: metadata->getValue(n, f64, count), data = f64, size = 8 * count; break;
        }
        put(type), put(strlen(key)), put(size), put(key, strlen(key)), put(data, size);
    }
    return 0;
}

static int write(const char* path) {
    int32_t head[8];
    for (int32_t& number : head) number = take();
    const int faces = head[4];
    const size_t pixel = Ptex::DataSize(Ptex::DataType(head[1])) * head[3];
    std::vector<Ptex::FaceInfo> infos;
    for (int face = 0; face < faces; face++) {
        int numbers[11];
        for (int& number : numbers) number = take();
        Ptex::Res res(numbers[0], numbers[1]);
        infos.push_back(Ptex::FaceInfo(res, numbers + 3, numbers + 7, numbers[2]));
    }
    std::vector<std::vector<char>> texels;
    for (int face = 0; face < faces; face++) texels.push_back(take(pixel * infos[face].res.size()));
    Ptex::String error;
    const auto began = std::chrono::steady_clock::now();
    PtexWriter* file = PtexWriter::open(
        path, Ptex::MeshType(head[0]), Ptex::DataType(head[1]), head[3], head[2], faces, error, true);
    if (!file) return fail(path, error);
    file->setBorderModes(Ptex::BorderMode(head[5]), Ptex::BorderMode(head[6]));
    file->setEdgeFilterMode(Ptex::EdgeFilterMode(head[7]));
    for (int face = 0; face < faces; face++) file->writeFace(face, infos[face], texels[face].data());
    for (int left = take(); left > 0; left--) {
        const int type = take(), name = take(), size = take();
        const std::string key(take(name).data(), name);
        const std::vector<char> value = take(size);
        const char* data = value.data();
        switch (type) {
            case Ptex::mdt_string: file->writeMeta(key.c_str(), data); break;
            case Ptex::mdt_int8: file->writeMeta(key.c_str(), (const int8_t*)data, size); break;
            case Ptex::mdt_int16: file->writeMeta(key.c_str(), (const int16_t*)data, size / 2); break;
            case Ptex::mdt_int32: file->writeMeta(key.c_str(), (const int32_t*)data, size / 4); break;
            case Ptex::mdt_float: file->writeMeta(key.c_str(), (const float*)data, size / 4); break;
            case Ptex::mdt_double: file->writeMeta(key.c_str(), (const double*)data, size / 8); break;
        }
    }
    if (!file->close(error)) return fail(path, error);
    file->release();
    const std::chrono::duration<double> spent = std::chrono::steady_clock::now() - began;
    printf("%.3f\n", spent.count());
    return 0;
}

int main(int count, char** words) {
    if (count == 3 && !strcmp(words[1], "dump")) return dump(words[2]);
    if (count == 3 && !strcmp(words[1], "write")) return write(words[2]);
    fprintf(stderr, "usage: ptex_peer dump FILE.ptx > DUMP | write FILE.ptx < CONTENTS\n");
    return 2;
}
