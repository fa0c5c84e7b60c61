/* Read an .octex file, mapped, from octex/formats/FORMAT.md: nearest and quadratic lookups. C99 and POSIX.

       cc -O2 -o read_octex read_octex.c -lm
       ./read_octex FILE CHANNEL nearest|quadratic < points.txt

   reads a rest position a line, prints its value a line, as octex.open(FILE).sample does (directions as means,
   not made unit vectors). Little-endian machines. */
#define _POSIX_C_SOURCE 200809L
#include <fcntl.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

enum { NONE, LEAF, NODE, BELOW }; /* BELOW: in a leaf of a level above */
typedef struct { const unsigned char *data; char dtype[4]; uint64_t shape[3]; } Array;

typedef struct {
    Array groups, cells, flags, kept, values, kept_values, alpha, kept_alpha;
    int depth, components;
    char space[16];
    double origin[3], size;
} File;

typedef struct {
    int kind, level; /* its own level, above that of the window for BELOW */
    uint64_t cell, node;
    int64_t low[3];   /* its lowest corner, in finest cells of 2^-21 */
    double h[10];   /* its coefficient: alpha·w·value, alpha·w, then w·value, w */
} Cell;

static void fail(const char *why) {
    fprintf(stderr, "read_octex: %s\n", why);
    exit(2);
}

/* Find the value of a key of the header; it holds no key twice. */
static const char *value_of(const char *header, const char *key) {
    size_t length = strlen(key);
    for (const char *at = header; (at = strstr(at, key)); at += length) {
        const char *after = at + length;
        if (at == header || at[-1] != '"' || *after != '"') continue;
        after += 1 + strspn(after + 1, " \t\n\r");
        if (*after == ':') return after + 1;
    }
    return NULL;
}

static int find_array(const char *header, const unsigned char *begin, uint64_t room, const char *name, Array *array) {
    const char *entry = value_of(header, name);
    memset(array, 0, sizeof *array);
    if (!entry) return 0;
    const char *dtype = value_of(entry, "dtype"), *shape = value_of(entry, "shape");
    const char *offsets = value_of(entry, "data_offsets");
    if (!dtype || !shape || !offsets) fail("damaged header");
    unsigned long long sizes[3] = {0, 1, 1}, first = 1, last = 0;
    sscanf(strchr(dtype, '"') + 1, "%3[A-Z0-9]", array->dtype);
    sscanf(strchr(shape, '['), "[%llu ,%llu ,%llu", &sizes[0], &sizes[1], &sizes[2]);
    sscanf(strchr(offsets, '['), "[%llu ,%llu", &first, &last);
    if (last < first || last > room) fail("damaged header");
    for (int n = 0; n < 3; n++) array->shape[n] = sizes[n];
    return array->data = begin + first, 1;
}

/* A word of 64 bits. */
static uint64_t word(const Array *array, uint64_t at) {
    uint64_t found;
    return memcpy(&found, array->data + 8 * at, 8), found;
}

static void open_file(const char *path, const char *channel, File *file) {
    int number = open(path, O_RDONLY);
    struct stat status;
    if (number < 0 || fstat(number, &status) || status.st_size < 8) fail("cannot read the file");
    uint64_t bytes = (uint64_t)status.st_size, length;
    const unsigned char *content = mmap(NULL, bytes, PROT_READ, MAP_PRIVATE, number, 0);
    if (content == MAP_FAILED) fail("cannot map the file");
    memcpy(&length, content, 8);
    if (length > bytes - 8) fail("cut off");
    char *header = calloc(length + 1, 1);
    memcpy(header, content + 8, length);
    const unsigned char *begin = content + 8 + length;
    uint64_t room = bytes - 8 - length;
    const char *format = value_of(header, "format"), *version = value_of(header, "format_version");
    if (!format || !version || !strstr(format, "\"octex\"") || strncmp(strchr(version, '"'), "\"1\"", 3))
        fail("not an .octex file of version 1");
    char name[256];
    int found = find_array(header, begin, room, "tree/groups", &file->groups);
    found += find_array(header, begin, room, "tree/level_cells", &file->cells);
    if (found + find_array(header, begin, room, "tree/flags", &file->flags) < 3) fail("damaged header");
    find_array(header, begin, room, "kept/cells", &file->kept);
    snprintf(name, sizeof name, "channels/%s", channel);
    if (!find_array(header, begin, room, name, &file->values)) fail("no such channel");
    snprintf(name, sizeof name, "kept/channels/%s", channel);
    find_array(header, begin, room, name, &file->kept_values);
    if (strcmp(channel, "alpha") && find_array(header, begin, room, "channels/alpha", &file->alpha))
        find_array(header, begin, room, "kept/channels/alpha", &file->kept_alpha);
    file->depth = (int)file->cells.shape[0] - 2;
    file->components = (int)file->values.shape[1];
    if (file->depth < 0 || file->depth > 21 || file->components > 4) fail("damaged header");
    /* JSON in a string of JSON: its quotes are \" */
    const char *placement = value_of(header, "placement"), *spaces = value_of(header, "channels");
    const char *origin = placement ? strstr(placement, "origin") : NULL;
    const char *size = placement ? strstr(placement, "size") : NULL;
    snprintf(name, sizeof name, "\"%s\\\"", channel);
    const char *space = spaces ? strstr(spaces, name) : NULL;
    double *o = file->origin;
    if (!origin || sscanf(strchr(origin, '['), "[%lf, %lf, %lf]", o, o + 1, o + 2) != 3 || !size ||
        sscanf(strchr(size, ':'), ": %lf", &file->size) != 1 || !space ||
        sscanf(strchr(space, ':'), ": \\\"%15[a-z]", file->space) != 1)
        fail("damaged header");
}

/* A stored number as what it stands for: linear light, -1 to 1 for directions. */
static double decoded(const Array *array, uint64_t at, const char *space) {
    double value;
    int is_whole = array->dtype[0] == 'U';
    float number;
    uint16_t bits;
    if (!strcmp(array->dtype, "U8")) value = array->data[at] / 255.0;
    else if (!strcmp(array->dtype, "F32")) memcpy(&number, array->data + 4 * at, 4), value = number;
    else if (memcpy(&bits, array->data + 2 * at, 2), is_whole) value = bits / 65535.0;
    else { /* half precision */
        int power = bits >> 10 & 31;
        value = ldexp(power ? 1024 + (bits & 1023) : bits & 1023, (power ? power : 1) - 25);
        if (bits >> 15) value = -value;
    }
    if (!strcmp(space, "srgb")) return value <= 0.04045 ? value / 12.92 : pow((value + 0.055) / 1.055, 2.4);
    return is_whole && !strcmp(space, "direction") ? 2 * value - 1 : value;
}

/* The coefficient of a row of values: of a cell, or of a kept node. */
static void set_own(const File *file, uint64_t row, int is_kept, double weight, double *h) {
    const Array *values = is_kept ? &file->kept_values : &file->values;
    double seen = weight;
    if (file->alpha.data) seen *= decoded(is_kept ? &file->kept_alpha : &file->alpha, row, "data");
    h[4] = seen, h[9] = weight;
    for (int n = 0; n < file->components; n++) {
        double value = decoded(values, row * file->components + n, file->space);
        h[n] = seen * value, h[5 + n] = weight * value;
    }
}

static uint64_t kept_row(const File *file, uint64_t cell) {
    for (uint64_t low = 0, high = file->kept.shape[0]; low < high;) {
        uint64_t middle = (low + high) / 2;
        uint32_t found;
        memcpy(&found, file->kept.data + 4 * middle, 4);
        if (found == cell) return middle;
        if (found < cell) low = middle + 1;
        else high = middle;
    }
    return fail("damaged tree"), 0;
}

static int is_kept(const File *file, const Cell *cell) {
    return cell->kind == NODE && file->flags.data[cell->cell] & 0x40;
}
/* Write the window of a level: 27 cells around the middle, x fastest, from that of the level above. */
static void go_down(const File *file, int deepest, int level, int64_t middles[][3], Cell windows[][27]) {
    Cell *window = windows[level];
    const int64_t *middle = middles[level], *middle_above = middles[level ? level - 1 : 0];
    for (int n = 0; n < 27; n++) {
        Cell *cell = &window[n];
        int64_t place[3], offset[3];
        int step[3] = {1, 3, 9};
        const Cell *parent = windows[level ? level - 1 : 0];
        *cell = (Cell){0};
        for (int a = 0; a < 3; a++) {
            place[a] = middle[a] + n / step[a] % 3 - 1;
            cell->low[a] = place[a] * ((int64_t)1 << (21 - level));
            offset[a] = level ? (place[a] >> 1) - middle_above[a] + 1 : 0;
            parent += level ? step[a] * offset[a] : 0;
        }
        if (level == 0) {
            if (n == 13) cell->kind = file->groups.shape[0] && deepest > 0 ? NODE : LEAF;
        } else if (parent->kind == LEAF || parent->kind == BELOW) {
            *cell = *parent;
            cell->kind = BELOW;
        } else if (parent->kind == NODE) {
            uint64_t group = parent->node >> 3, nodes = word(&file->groups, 3 * group);
            uint64_t stored = nodes | word(&file->groups, 3 * group + 1), first = word(&file->groups, 3 * group + 2);
            int octant = (int)((place[0] & 1) + 2 * (place[1] & 1) + 4 * (place[2] & 1));
            uint64_t bit = (uint64_t)1 << (8 * (parent->node & 7) + octant);
            if (stored & bit) {
                cell->kind = nodes & bit && level < deepest ? NODE : LEAF;
                cell->cell = first >> 32, cell->node = first & 0xFFFFFFFF;
                for (uint64_t below = stored & (bit - 1); below; below &= below - 1) cell->cell++;
                for (uint64_t below = nodes & (bit - 1); below; below &= below - 1) cell->node++;
                if (cell->cell >= file->flags.shape[0] || (cell->kind == NODE && cell->node / 8 >= file->groups.shape[0])) fail("damaged tree");
            }
        }
        if (cell->kind != BELOW) cell->level = level;
        double weight = 1;
        memset(cell->h, 0, sizeof cell->h);
        if (level && (parent->kind != NODE || is_kept(file, parent))) {
            double refined[10] = {0};
            for (int o = 0; o < 8; o++) { /* the parent, and the next one on each axis */
                const Cell *from = parent;
                double share = 1;
                for (int a = 0; a < 3; a++) {
                    share *= o >> a & 1 ? 0.25 : 0.75;
                    if (o >> a & 1) from += place[a] & 1 ? step[a] : -step[a];
                }
                for (int c = 0; c < 10; c++) refined[c] += share * from->h[c];
            }
            weight = refined[9];
            if (parent->kind != NODE || cell->kind == NONE) memcpy(cell->h, refined, sizeof refined);
            if (parent->kind != NODE) continue;
        }
        if (cell->kind == LEAF) set_own(file, cell->cell, 0, weight, cell->h);
        if (is_kept(file, cell)) set_own(file, kept_row(file, cell->cell), 1, weight, cell->h);
    }
}

static double away(const Cell *cell, const double *point) {
    double total = 0;
    for (int a = 0; a < 3; a++) {
        double low = ldexp((double)cell->low[a], -21), high = low + ldexp(1, -cell->level);
        total += pow(fmax(fmax(low - point[a], point[a] - high), 0), 2);
    }
    return total;
}

/* Whether a cell comes before another in Morton order: by the axis of their highest bit that differs. */
static int is_before(const Cell *a, const Cell *b) {
    int axis = 0;
    for (int n = 1; n < 3; n++) {
        int64_t most = a->low[axis] ^ b->low[axis], own = a->low[n] ^ b->low[n];
        if (own >= most || own > (own ^ most)) axis = n;
    }
    return a->low[axis] < b->low[axis];
}

static void look_up(const File *file, const double *rest, int is_nearest, double *value) {
    static Cell windows[22][27];
    double point[3];
    int64_t fixed[3], middles[22][3];
    for (int a = 0; a < 3; a++) {
        point[a] = fmin(fmax((rest[a] - file->origin[a]) / file->size, 0), 1);
        fixed[a] = is_nearest ? (int64_t)(point[a] * (1 << 30) + 0.5) >> 9 : (int64_t)(point[a] * (1 << 21));
        if (fixed[a] > (1 << 21) - 1) fixed[a] = (1 << 21) - 1;
    }
    for (int deepest = file->depth; deepest >= 0; deepest--) {
        int level = 0, has_nodes = 1;
        for (; level <= deepest; level++) {
            has_nodes = 0;
            for (int a = 0; a < 3; a++) middles[level][a] = fixed[a] >> (21 - level);
            go_down(file, deepest, level, middles, windows);
            for (int n = 0; n < 27; n++) has_nodes |= windows[level][n].kind == NODE;
            if (!has_nodes && !is_nearest) break;
        }
        if (is_nearest) {
            const Cell *best = NULL;
            for (level = deepest; level >= 0 && !best; level--) {
                const Cell *window = windows[level];
                if (window[13].kind == LEAF || window[13].kind == BELOW) best = &window[13];
                else for (int n = 0; n < 27; n++) {
                    double d = window[n].kind == NONE ? INFINITY : away(&window[n], point);
                    if (d == INFINITY) continue;
                    double least = best ? away(best, point) : INFINITY;
                    if (d < least || (d == least && is_before(&window[n], best))) best = &window[n];
                }
            }
            Cell row;
            set_own(file, best->cell, 0, 1, row.h);
            memcpy(value, row.h + 5, 4 * sizeof *value);
            return;
        }
        double total[10] = {0}, spline[3][3];
        for (int a = 0; a < 3; a++) {
            double t = ldexp(point[a], level) - (double)middles[level][a];
            spline[a][0] = (1 - t) * (1 - t) / 2, spline[a][1] = 0.75 - (t - 0.5) * (t - 0.5), spline[a][2] = t * t / 2;
        }
        for (int n = 0; n < 27; n++)
            for (int c = 0; c < 10; c++)
                total[c] += spline[0][n % 3] * spline[1][n / 3 % 3] * spline[2][n / 9] * windows[level][n].h[c];
        if (total[9] > 0 || !deepest) { /* else off the surface: a level's averages answer */
            const double *seen = total[4] > 0 ? total : total + 5;
            for (int n = 0; n < file->components; n++) value[n] = seen[n] / seen[4];
            return;
        }
    }
}

int main(int count, char **words) {
    File file = {0};
    double rest[3], value[4];
    if (count != 4) fail("usage: read_octex FILE CHANNEL nearest|quadratic < points.txt");
    open_file(words[1], words[2], &file);
    while (scanf("%lf %lf %lf", &rest[0], &rest[1], &rest[2]) == 3) {
        look_up(&file, rest, !strcmp(words[3], "nearest"), value);
        for (int n = 0; n < file.components; n++) printf("%.9g%c", value[n], n + 1 < file.components ? ' ' : '\n');
    }
}
