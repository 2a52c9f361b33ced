// Sensor kernels for balls and a transparent robot. They fuse the computations of
// geometry.py, field.py and ray.py over blocks of rows, so that intermediate results
// stay in the cache. compilation.py builds and binding.py calls them; the PyTorch
// code is the reference.
//
// Contract: every number is bit-identical to that of the PyTorch code in float32, except
// for the sign of zero. Sums are therefore in the order of the Python code, and nothing
// may be contracted or reassociated: compile with -ffp-contract=off, never with
// -ffast-math.
//
// All pointers are to contiguous arrays unless a stride is given.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <numeric>
#include <vector>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

extern "C" {

// Data that is constant over calls; matrices are row-major.
struct Tables {
  int64_t joints, steps, links, sensors, objects;
  int64_t beams;               // per sensor; 0 for a field
  int64_t reduce, apart;       // flags: minimum of the beams, per object
  const int64_t *joint;        // of each step; -1: none               [steps]
  const int64_t *parent;       // frame in which a step starts         [steps]
  const int64_t *frame;        // of each link; 0 is the base          [links]
  const int64_t *link;         // of each sensor                       [sensors]
  const float *constant, *by_cos, *by_sin; // rotation of a step       [steps, 3, 3]
  const float *shift, *slide;  // its translation                      [steps, 3]
  const float *offset;         // of the sensor in its link            [sensors, 3]
  const float *axes;           // of the sensor frame, as rows         [sensors, 3, 3]
  const float *range;          //                                      [sensors]
  const float *radius, *squared, *bound; // of each object             [objects]
  const float *farthest;       // largest distance from base in range  [objects]
  // Field.
  const float *cos_half;       // -inf: sees everything; null: all do   [sensors]
  // Ray.
  const float *reach;          // largest distance of a hit            [sensors]
  const float *pyramid;        // cosines, then sines of the half angles [sensors, 4]
  const float *directions;     // of each kind of grid          [grids, 3, beams]
  const int64_t *grid;         // of each sensor                       [sensors]
  const uint8_t *depth;        // null: distances along the beam       [sensors]
};

// Rows of base pose, joint positions, object poses and active flags, and their strides.
struct Inputs {
  int64_t rows;
  const void *data[4];
  int64_t stride[4];
};
}

namespace {

constexpr float inf = std::numeric_limits<float>::infinity();
// Rows per block: one number of each fills an AVX-512 register.
constexpr int W = 16;

typedef float V __attribute__((vector_size(W * sizeof(float))));

V sqrt_of(V x) {
  for (int i = 0; i < W; i++) x[i] = std::sqrt(x[i]);
  return x;
}

V floor_of(V x) {
  for (int i = 0; i < W; i++) x[i] = std::floor(x[i]);
  return x;
}

V round_of(V x) {
  for (int i = 0; i < W; i++) x[i] = std::nearbyint(x[i]);
  return x;
}

V filled(float x) { return V{} + x; }

// A mask is -1 or 0 in each lane.
using Mask = decltype(V{} < V{});
typedef int8_t Bytes __attribute__((vector_size(W)));

Bytes bytes(Mask mask) { return __builtin_convertvector(mask, Bytes); }

// One bit per lane. A product gathers the bits of eight bytes that are -1 or 0; byte 0
// is the lowest (little-endian).
uint32_t bits(Bytes mask) {
  uint64_t halves[2];
  std::memcpy(halves, &mask, W);
  for (auto &half : halves)
    half = (half & 0x8040201008040201) * 0x0101010101010101 >> 56;
  return halves[0] | halves[1] << 8;
}

bool any(Bytes mask) {
  uint64_t halves[2];
  std::memcpy(halves, &mask, W);
  return halves[0] | halves[1];
}

// Minimum; NaN if either is NaN.
V least(V a, V b) {
  V low = b < a ? b : a;
  return b != b ? b : low;
}

float lesser(float a, float b) { return b < a || b != b ? b : a; }

// Minimum over lanes, none of which may be NaN, without branches.
float least_of(V x) {
  float lanes[W];
  std::memcpy(lanes, &x, sizeof(x));
#pragma GCC unroll 4
  for (int half = W / 2; half; half /= 2)
    for (int i = 0; i < half; i++)
      lanes[i] = lanes[i + half] < lanes[i] ? lanes[i + half] : lanes[i];
  return lanes[0];
}

// Transposes a W x W matrix by recursive halving: vector i, with number i of each row,
// becomes row i.
void transpose(V (&x)[W]) {
#pragma GCC unroll 4
  for (int half = W / 2; half; half /= 2) {
    Mask low, high;
    for (int i = 0; i < W; i++) {
      low[i] = i & half ? W + i - half : i;
      high[i] = i & half ? W + i : i + half;
    }
#pragma GCC unroll 16
    for (int i = 0; i < W; i++) {
      if (i & half) continue;
      V a = x[i], b = x[i + half];
#ifdef __clang__
      for (int j = 0; j < W; j++) {
        x[i][j] = j & half ? b[j - half] : a[j];
        x[i + half][j] = j & half ? b[j] : a[j + half];
      }
#else
      x[i] = __builtin_shuffle(a, b, low);
      x[i + half] = __builtin_shuffle(a, b, high);
#endif
    }
  }
}

// sincos of egoskin/rounding.py.
void sincos(V x, V &sine, V &cosine) {
  constexpr int terms = 5;
  V n = round_of(x * float(2 / 3.141592653589793));
  V r = ((x - n * 1.5703125f) - n * 4.837512969970703125e-4f) -
        n * 7.54978995489188216e-8f;
  V z = r * r, s{}, c{};
  double factorial[2 * terms + 1] = {1};
  for (int i = 1; i <= 2 * terms; i++) factorial[i] = factorial[i - 1] * i;
  for (int i = terms - 1; i > 0; i--) {
    double sign = i % 2 ? -1 : 1;
    s = (s + float(sign / factorial[2 * i + 1])) * z;
    c = (c + float(-sign / factorial[2 * i + 2])) * z;
  }
  s = r + r * s;
  c = z * (c - 0.5f) + 1.0f;
  V half = floor_of(n * 0.5f);
  V sign = filled(1) - (half - floor_of(half * 0.5f) * 2.0f) * 2.0f;
  auto swapped = n - half * 2.0f > 0.5f;
  sine = (swapped ? c : s) * sign;
  cosine = (swapped ? -s : c) * sign;
}

struct Frame {
  V r[3][3], p[3];
};

// Intermediate results for a block of rows.
struct Block {
  explicit Block(const Tables &t)
      : turns(t.steps), frames(t.steps + 1), centre(t.objects * t.links),
        active(t.objects) {}

  struct Turn {
    V joint, sine, cosine;
  };
  std::vector<Turn> turns;      // of each step
  std::vector<Frame> frames;    // in the base frame; the base is the first
  bool finite = true;           // whether all inputs of all rows are finite
  struct Point {
    V x[3];
  };
  std::vector<Point> centre; // of each object in each link's frame
  std::vector<V> active;     // 1 or 0
};

template <class T> const T *as(const void *pointer) {
  return static_cast<const T *>(pointer);
}

enum Input { BASE, JOINT_POS, OBJECT_POSE, ACTIVE };

// A block of rows and their inputs; lanes beyond the last row repeat it.
struct Rows {
  // Takes up to W rows of a list, starting at index `first`.
  Rows(const Inputs &in, const std::vector<int64_t> &list, size_t first)
      : in(in), count(std::min<int64_t>(W, list.size() - first)) {
    for (int i = 0; i < W; i++) row[i] = list[std::min(first + i, list.size() - 1)];
    for (int input = 0; input < 4; input++)
      for (int i = 0; i < W; i++) offset[input][i] = row[i] * in.stride[input];
  }

  // One number of each row.
  template <class N = float> V column(Input input, int64_t at) const {
    const N *data = as<N>(in.data[input]) + at;
    V x;
    for (int i = 0; i < W; i++) x[i] = data[offset[input][i]];
    return x;
  }

  // 0, or NaN if any of the numbers of a row is NaN or infinite.
  V poison(Input input, int64_t first, int64_t count) const {
    V sum{};
    for (int64_t i = first; i < first + count; i++) sum += column(input, i) * 0.0f;
    return sum;
  }

  const Inputs &in;
  int count;
  int64_t row[W], offset[4][W];
};

// Writes `count` numbers per row, to rows `stride` apart; vector i holds number i of
// all rows.
void write_rows(const V *numbers, int64_t count, const Rows &rows, float *out,
                int64_t stride) {
  int64_t i = 0;
  for (; i + W <= count; i += W) {
    V tile[W];
    std::copy_n(numbers + i, W, tile);
    // Prefetch two tiles ahead: these are too many streams for the hardware prefetcher.
    float *to = out + i;
#pragma GCC unroll 16
    for (int k = 0; k < W; k++)
      __builtin_prefetch(to + rows.row[k] * stride + 2 * W, 1);
    transpose(tile);
    // Lanes beyond the last row rewrite it. Unrolled to keep the tile in registers.
#pragma GCC unroll 16
    for (int k = 0; k < W; k++)
      std::memcpy(to + rows.row[k] * stride, &tile[k], sizeof(tile[k]));
  }
  for (; i < count; i++)
    for (int k = 0; k < rows.count; k++) out[rows.row[k] * stride + i] = numbers[i][k];
}

// Whether `count` numbers of each row are all finite, tested by their exponents.
bool finite(const Inputs &in, Input input, int64_t first, int64_t count) {
  constexpr uint32_t exponent = 0x7f800000;
  uint32_t found = 0;
  const uint32_t *data = as<uint32_t>(in.data[input]) + first;
  if (in.stride[input] == count) {
    // Rows without gaps are treated as a single row.
    for (int64_t i = 0; i < in.rows * count; i++)
      found |= (data[i] & exponent) == exponent;
    return !found;
  }
  for (int64_t row = 0; row < in.rows; row++, data += in.stride[input])
    for (int64_t i = 0; i < count; i++)
      found |= (data[i] & exponent) == exponent;
  return !found;
}

bool finite(const Tables &t, const Inputs &in) {
  bool all = finite(in, BASE, 0, 7) && finite(in, JOINT_POS, 0, t.joints);
  for (int64_t object = 0; object < t.objects; object++)
    all = all && finite(in, OBJECT_POSE, 7 * object, 7);
  return all;
}

// ProximitySensor._rows_in_reach: rows in which an active object may be in range for
// some robot pose, or is NaN. In all other rows nothing is detected.
std::vector<int64_t> rows_in_reach(const Tables &t, const Inputs &in, bool finite) {
  std::vector<int64_t> rows(in.rows);
  size_t count = 0;
  for (int64_t row = 0; row < in.rows; row++) {
    const float *base = as<float>(in.data[BASE]) + row * in.stride[BASE];
    const float *pose = as<float>(in.data[OBJECT_POSE]) + row * in.stride[OBJECT_POSE];
    const uint8_t *active = as<uint8_t>(in.data[ACTIVE]) + row * in.stride[ACTIVE];
    float turn = 0;
    for (int i = 3; i < 7; i++) turn += base[i] * base[i];
    bool near = false;
    for (int64_t object = 0; object < t.objects; object++, pose += 7) {
      const float farthest = t.farthest[object];
      float away = 0;
      for (int i = 0; i < 3; i++) away += (pose[i] - base[i]) * (pose[i] - base[i]);
      const bool beyond = (away > farthest * farthest) & (turn > 0) & finite;
      near |= bool(active[object]) & !beyond;
    }
    rows[count] = row;
    count += near;
  }
  rows.resize(count);
  return rows;
}

// LinkKinematics: computes the frames of all steps.
void place_frames(const Tables &t, const Rows &rows, Block &block) {
  Frame &base = block.frames[0];
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) base.r[i][j] = filled(i == j);
    base.p[i] = filled(0);
  }
  // In a separate loop, since these computations are independent of each other.
  for (int64_t step = 0; step < t.steps; step++) {
    auto &[q, s, c] = block.turns[step];
    q = t.joint[step] < 0 ? V{} : rows.column(JOINT_POS, t.joint[step]);
    sincos(q, s, c);
  }
  for (int64_t step = 0; step < t.steps; step++) {
    const Frame &from = block.frames[t.parent[step]];
    Frame &to = block.frames[step + 1];
    const auto &[q, s, c] = block.turns[step];
    V turn[3][3], way[3];
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) {
        int64_t at = 9 * step + 3 * i + j;
        turn[i][j] = (c * t.by_cos[at] + t.constant[at]) + s * t.by_sin[at];
      }
      way[i] = q * t.slide[3 * step + i] + t.shift[3 * step + i];
    }
    for (int i = 0; i < 3; i++) {
      const V *r = from.r[i];
      for (int j = 0; j < 3; j++)
        to.r[i][j] = r[0] * turn[0][j] + r[1] * turn[1][j] + r[2] * turn[2][j];
      to.p[i] = from.p[i] + ((r[0] * way[0] + r[1] * way[1]) + r[2] * way[2]);
    }
  }
}

// ProximitySensor.views: object centres in the link frames. A NaN in the base pose
// or joints makes all centres of the row NaN; a NaN in an object's pose, its own.
void place_objects(const Tables &t, const Rows &rows, Block &block) {
  V base[7], poison{};
  for (int j = 0; j < 7; j++) base[j] = rows.column(BASE, j);
  if (!block.finite)
    poison = rows.poison(JOINT_POS, 0, t.joints) + rows.poison(BASE, 0, 7);
  V w = base[3], x = base[4], y = base[5], z = base[6], one = filled(1);
  V s = filled(2) / (w * w + x * x + y * y + z * z);
  V turn[3][3] = {
      {one - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)},
      {s * (x * y + w * z), one - s * (x * x + z * z), s * (y * z - w * x)},
      {s * (x * z - w * y), s * (y * z + w * x), one - s * (x * x + y * y)}};
  for (int64_t object = 0; object < t.objects; object++) {
    V d[3], centre[3];
    for (int i = 0; i < 3; i++)
      d[i] = rows.column(OBJECT_POSE, 7 * object + i) - base[i];
    if (!block.finite) {
      V own = poison + rows.poison(OBJECT_POSE, 7 * object, 7);
      for (auto &x : d) x += own;
    }
    for (int i = 0; i < 3; i++)
      centre[i] = turn[0][i] * d[0] + turn[1][i] * d[1] + turn[2][i] * d[2];
    for (int64_t link = 0; link < t.links; link++) {
      const Frame &frame = block.frames[t.frame[link]];
      for (int i = 0; i < 3; i++) d[i] = centre[i] - frame.p[i];
      auto &seen = block.centre[object * t.links + link].x;
      for (int i = 0; i < 3; i++)
        seen[i] = frame.r[0][i] * d[0] + frame.r[1][i] * d[1] + frame.r[2][i] * d[2];
    }
    block.active[object] = rows.column<uint8_t>(ACTIVE, object);
  }
}

// Vector from a sensor to an object's centre, in the frame of the sensor's link.
void to_centre(const Tables &t, const Block &block, int64_t object, int64_t sensor,
               V (&away)[3]) {
  const auto &centre = block.centre[object * t.links + t.link[sensor]].x;
  for (int i = 0; i < 3; i++)
    away[i] = centre[i] - t.offset[3 * sensor + i];
}

// FieldSensor.
void field(const Tables &t, const Inputs &in, float *out, uint8_t *detected) {
  Block block(t);
  block.finite = finite(t, in);
  std::vector<V> nearest(t.sensors);
  const std::vector<int64_t> reached = rows_in_reach(t, in, block.finite);
  for (size_t first = 0; first < reached.size(); first += W) {
    const Rows rows(in, reached, first);
    place_frames(t, rows, block);
    place_objects(t, rows, block);
    for (int64_t object = 0; object < t.objects; object++) {
      auto on = block.active[object] != 0.0f;
      auto found = on & ~on;
      const bool only = t.apart || object == 0;
      for (int64_t sensor = 0; sensor < t.sensors; sensor++) {
        V v[3];
        to_centre(t, block, object, sensor, v);
        V reach = sqrt_of(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
        V distance = reach - t.radius[object];
        distance = distance < 0.0f ? filled(0) : distance;
        if (t.cos_half) {
          const float *n = t.axes + 9 * sensor + 6;
          V along = v[0] * n[0] + v[1] * n[1] + v[2] * n[2];
          auto beside = (along < reach * t.cos_half[sensor]) & ~(distance <= 0.0f);
          distance = beside ? filled(inf) : distance;
        }
        auto gone = (distance > t.range[sensor]) | ~on;
        distance = gone ? filled(inf) : distance;
        found |= distance != inf;
        nearest[sensor] = only ? distance : least(nearest[sensor], distance);
      }
      for (int i = 0; i < rows.count; i++)
        detected[rows.row[i] * t.objects + object] = found[i] != 0;
      if (t.apart)
        write_rows(nearest.data(), t.sensors, rows,
                      out + object * in.rows * t.sensors, t.sensors);
    }
    if (!t.apart) write_rows(nearest.data(), t.sensors, rows, out, t.sensors);
  }
  // All other rows: nothing detected.
  float *next = out;
  for (int64_t plane = 0; plane < (t.apart ? t.objects : 1); plane++)
    for (int64_t row : reached) {
      float *read = out + (plane * in.rows + row) * t.sensors;
      std::fill(next, read, inf);
      next = read + t.sensors;
    }
  std::fill(next, out + (t.apart ? t.objects : 1) * in.rows * t.sensors, inf);
}

// ProximitySensor.poses_b: position [rows, sensors, 3], rotation [rows, sensors, 3, 3].
void poses(const Tables &t, const Inputs &in, float *position, float *rotation) {
  Block block(t);
  std::vector<int64_t> all(in.rows);
  std::iota(all.begin(), all.end(), 0);
  for (size_t begin = 0; begin < all.size(); begin += W) {
    const Rows rows(in, all, begin);
    place_frames(t, rows, block);
    // In groups of W sensors, so that the numbers per row fill whole vectors.
    for (int64_t first = 0; first < t.sensors; first += W) {
      int64_t some = std::min<int64_t>(W, t.sensors - first);
      V p[W][3], r[W][3][3];
      for (int64_t i = 0; i < some; i++) {
        int64_t sensor = first + i;
        const Frame &link = block.frames[t.frame[t.link[sensor]]];
        const float *o = t.offset + 3 * sensor, *axes = t.axes + 9 * sensor;
        for (int j = 0; j < 3; j++) {
          const V *a = link.r[j];
          p[i][j] = link.p[j] + (a[0] * o[0] + a[1] * o[1] + a[2] * o[2]);
          for (int k = 0; k < 3; k++) {
            const float *b = axes + 3 * k;
            r[i][j][k] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
          }
        }
      }
      write_rows(&p[0][0], 3 * some, rows, position + 3 * first, 3 * t.sensors);
      write_rows(&r[0][0][0], 9 * some, rows, rotation + 9 * first, 9 * t.sensors);
    }
  }
}

// A sensor and an object that it may detect, in one row of the block.
struct Pair {
  int64_t sensor, object;
  float centre[3]; // in the sensor's frame
};

// RaySensor.margins: finds the pairs with possible hits, including pairs with NaN.
void find_pairs(const Tables &t, const Block &block, int64_t count,
                std::vector<Pair> (&pairs)[W]) {
  const uint32_t rows = (1u << count) - 1;
  for (auto &of_row : pairs) of_row.clear();
  for (int64_t sensor = 0; sensor < t.sensors; sensor++) {
    const float *axes = t.axes + 9 * sensor;
    const float *cos = t.pyramid + 4 * sensor, *sin = cos + 2;
    for (int64_t object = 0; object < t.objects; object++) {
      V v[3], c[3];
      to_centre(t, block, object, sensor, v);
      for (int i = 0; i < 3; i++)
        c[i] = v[0] * axes[3 * i] + v[1] * axes[3 * i + 1] + v[2] * axes[3 * i + 2];
      // Outside the range, behind the sensor, or beyond a side of the pyramid.
      const float farthest = t.reach[sensor] + t.bound[object];
      V far = c[0] * c[0] + c[1] * c[1] + c[2] * c[2];
      V x = c[0] < 0.0f ? -c[0] : c[0], y = c[1] < 0.0f ? -c[1] : c[1];
      V bound = filled(t.bound[object]);
      auto out = (far >= farthest * farthest) | (x * cos[0] - c[2] * sin[0] >= bound) |
                 (y * cos[1] - c[2] * sin[1] >= bound) | (-c[2] >= bound);
      out = out | (block.active[object] == 0.0f);
      const Bytes seen = bytes(~out);
      if (!any(seen)) continue;
      for (uint32_t left = bits(seen) & rows; left; left &= left - 1) {
        const int i = __builtin_ctz(left);
        pairs[i].push_back({sensor, object, {c[0][i], c[1][i], c[2][i]}});
      }
    }
  }
}

// RaySensor.read: writes the readings of a pair's beams and returns their minimum.
// `out` has room for whole vectors.
float read_beams(const Tables &t, const Pair &pair, V *out) {
  const int64_t sensor = pair.sensor, vectors = (t.beams + W - 1) / W;
  const float *directions = t.directions + 3 * W * vectors * t.grid[sensor];
  const float px = -pair.centre[0], py = -pair.centre[1], pz = -pair.centre[2];
  const float squared = t.squared[pair.object], range = t.range[sensor];
  const bool depth = t.depth && t.depth[sensor];
  const float away = px * px + py * py + pz * pz;
  V nearest = filled(inf);
  for (int64_t i = 0; i < vectors; i++) {
    V d[3];
    for (int j = 0; j < 3; j++)
      std::memcpy(&d[j], directions + (j * vectors + i) * W, sizeof(d[j]));
    V along = -(px * d[0] + py * d[1] + pz * d[2]);
    // _ball_interval and first_hit of shapes.py
    V qx = px + along * d[0], qy = py + along * d[1], qz = pz + along * d[2];
    V inside = squared - (qx * qx + qy * qy + qz * qz);
    V half = sqrt_of(inside);
    V distance = along - half, leave = along + half;
    distance = distance < 0.0f ? filled(0) : distance;
    distance = (inside < 0.0f) | (leave < 0.0f) ? filled(inf) : distance;
    distance = depth ? distance * d[2] : distance;
    distance = distance > range ? filled(inf) : distance;
    out[i] = distance;
    nearest = distance < nearest ? distance : nearest;
  }
  // Readings can be NaN only if the centre is NaN or infinite.
  if (away - away == 0.0f) return least_of(nearest);
  const float *reading = reinterpret_cast<const float *>(out);
  return std::accumulate(reading, reading + t.beams, inf, lesser);
}

// Delivers the readings of each sensor, per object or the minimum over objects.
template <class Deliver>
void each_reading(const Tables &t, const std::vector<Pair> &pairs, V *read,
                  V *other, uint8_t *detected, Deliver deliver) {
  const int64_t vectors = (t.beams + W - 1) / W;
  for (size_t i = 0; i < pairs.size();) {
    const Pair &pair = pairs[i];
    float nearest = read_beams(t, pair, read);
    detected[pair.object] |= nearest != inf;
    for (i++; !t.apart && i < pairs.size() && pairs[i].sensor == pair.sensor; i++) {
      float own = read_beams(t, pairs[i], other);
      detected[pairs[i].object] |= own != inf;
      nearest = lesser(nearest, own);
      for (int64_t k = 0; k < vectors; k++) read[k] = least(read[k], other[k]);
    }
    if (nearest != inf) deliver(pair, reinterpret_cast<const float *>(read), nearest);
  }
}

// RaySensor: delivers the readings of sensors with a hit, in the order of the grid.
template <class Deliver>
void rays(const Tables &t, const Inputs &in, uint8_t *detected, Deliver deliver) {
  Block block(t);
  std::vector<Pair> pairs[W];
  const int64_t vectors = (t.beams + W - 1) / W;
  std::vector<V> buffer(2 * vectors);
  block.finite = finite(t, in);
  const std::vector<int64_t> reached = rows_in_reach(t, in, block.finite);
  for (size_t first = 0; first < reached.size(); first += W) {
    const Rows rows(in, reached, first);
    place_frames(t, rows, block);
    place_objects(t, rows, block);
    find_pairs(t, block, rows.count, pairs);
    for (int i = 0; i < rows.count; i++)
      each_reading(t, pairs[i], buffer.data(), buffer.data() + vectors,
                      detected + rows.row[i] * t.objects,
                      [&](const Pair &pair, const float *reading, float nearest) {
                        deliver(rows.row[i], pair, reading, nearest);
                      });
  }
}

// Sequential writer of an array. Large arrays bypass the cache: they would evict
// its contents, and make the processor read each line before overwriting it.
class Stream {
public:
  // Whether to bypass the cache: if the array is far larger than it and its pieces are
  // whole cache lines.
  static bool serves(const float *out, int64_t piece, int64_t size) {
#ifdef __SSE2__
    return size * sizeof(float) > MANY && piece * sizeof(float) % LINE == 0 &&
           reinterpret_cast<uintptr_t>(out) % LINE == 0;
#else
    return false;
#endif
  }

  Stream(float *out, bool past_cache) : next(out), past_cache(past_cache) {}

  void fill(float *end, float value) {
    if (!past_cache) {
      std::fill(next, end, value);
      next = end;
      return;
    }
    float line[NUMBERS];
    std::fill_n(line, NUMBERS, value);
    while (next < end) write(line);
  }

  void copy(const float *from, int64_t count) {
    if (!past_cache) {
      next = std::copy_n(from, count, next);
      return;
    }
    for (const float *end = next + count; next < end; from += NUMBERS) write(from);
  }

  // Makes the written data visible to other threads.
  static void finish() {
#ifdef __SSE2__
    _mm_sfence();
#endif
  }

private:
  static constexpr size_t MANY = 32 << 20, LINE = 64; // [bytes]
  static constexpr size_t NUMBERS = LINE / sizeof(float);
  float *next;
  bool past_cache;

  void write(const float *line) {
#ifdef __SSE2__
    __m128i parts[LINE / 16];
    std::memcpy(parts, line, LINE);
    for (size_t i = 0; i < LINE / 16; i++)
      _mm_stream_si128(reinterpret_cast<__m128i *>(next) + i, parts[i]);
#endif
    next += NUMBERS;
  }
};

// The readings of all beams, or the minimum of each sensor.
void ray(const Tables &t, const Inputs &in, float *out, uint8_t *detected) {
  const int64_t beams = t.reduce ? 1 : t.beams, size = t.sensors * beams;
  const int64_t planes = t.apart ? t.objects : 1, plane = in.rows * size;
  const bool past_cache = Stream::serves(out, beams, planes * plane);
  std::vector<Stream> streams;
  for (int64_t i = 0; i < planes; i++)
    streams.emplace_back(out + i * plane, past_cache);
  rays(t, in, detected,
          [&](int64_t row, const Pair &pair, const float *reading, float nearest) {
            const int64_t i = t.apart ? pair.object : 0;
            streams[i].fill(out + i * plane + row * size + pair.sensor * beams, inf);
            streams[i].copy(t.reduce ? &nearest : reading, beams);
          });
  for (int64_t i = 0; i < planes; i++) streams[i].fill(out + (i + 1) * plane, inf);
  Stream::finish();
}

// RaySensor.hits: ascending indices of hits in the grid, and their readings. Returns
// the number of hits, of which at most `capacity` are written.
int64_t hits(const Tables &t, const Inputs &in, int64_t capacity, int64_t *place,
             float *reading) {
  std::vector<uint8_t> detected(in.rows * t.objects);
  int64_t found = 0;
  rays(t, in, detected.data(),
          [&](int64_t row, const Pair &pair, const float *read, float) {
            for (int64_t k = 0; k < t.beams; k++) {
              if (read[k] == inf) continue;
              if (found < capacity) {
                place[found] = (row * t.sensors + pair.sensor) * t.beams + k;
                reading[found] = read[k];
              }
              found++;
            }
          });
  return found;
}

} // namespace

extern "C" {

void egoskin_field(const Tables *t, const Inputs *in, float *out, uint8_t *detected) {
  field(*t, *in, out, detected);
}

void egoskin_ray(const Tables *t, const Inputs *in, float *out, uint8_t *detected) {
  ray(*t, *in, out, detected);
}

int64_t egoskin_hits(const Tables *t, const Inputs *in, int64_t capacity, int64_t *place,
                     float *reading) {
  return hits(*t, *in, capacity, place, reading);
}

void egoskin_poses(const Tables *t, const Inputs *in, float *position, float *rotation) {
  poses(*t, *in, position, rotation);
}
}
