// Colours of pixels and their gradients; see hmt_ros/image/person_colours.py and background.py.
#pragma once

#include "images.h"

namespace hmt {

using Picture = Array<const std::uint8_t, 3>;  // (h, w, 3) BGR
using PictureDerivative = Array<const std::int16_t, 3>;

// The bin (h, w) of the colour of each pixel of an image; a channel has `count` bins.
inline void bin_colours(const Picture& image, Index count, const Array<std::uint16_t, 2>& bins) {
  expect_shape("image", image, {-1, -1, 3});
  expect_shape("bins", bins, {image.size(0), image.size(1)});
  expect(count >= 1 && count <= 32, "count", "1 to 32 bins of a channel");
  std::array<std::array<std::uint16_t, 256>, 3> parts;
  for (Index value = 0; value < 256; ++value) {
    const Index bin = value * count / 256;
    parts[0][value] = std::uint16_t(bin * count * count);
    parts[1][value] = std::uint16_t(bin * count);
    parts[2][value] = std::uint16_t(bin);
  }
  const std::uint8_t* pixel = image.data;
  for (std::uint16_t& result : bins) {
    result = std::uint16_t(parts[0][pixel[0]] + parts[1][pixel[1]] + parts[2][pixel[2]]);
    pixel += 3;
  }
}

// counts (R, C): number of pixels of each region (h, w), 0 to R - 1, in each bin of colours.
inline void count_colours(const Array<const std::uint16_t, 2>& bins, const Bytes& regions,
                          const Array<Index, 2>& counts) {
  expect_shape("regions", regions, {bins.size(0), bins.size(1)});
  const Index colours = counts.size(1), pixels = bins.count();
  // Neighbours often have the same colour, so two counters take turns and do not wait for each
  // other.
  std::vector<std::int32_t> own(2 * counts.count(), 0);
  for (Index i = 0; i < pixels; ++i) {
    const Index bin = bins.data[i], region = regions.data[i];
    if (bin >= colours) expect(false, "bins", "bins that are counted");
    if (region >= counts.size(0)) expect(false, "regions", "regions that are counted");
    ++own[2 * (region * colours + bin) + (i & 1)];
  }
  for (Index i = 0; i < counts.count(); ++i) counts.data[i] = own[2 * i] + own[2 * i + 1];
}

// Lengths (h, w) of the gradients of an image, in the channel where they are the longest.
inline void gradient_lengths(const PictureDerivative& dx, const PictureDerivative& dy,
                             double longest, const Array<float, 2>& lengths) {
  expect_shape("dx", dx, {-1, -1, 3});
  expect_shape("dy", dy, {dx.size(0), dx.size(1), 3});
  expect_shape("lengths", lengths, {dx.size(0), dx.size(1)});
  const std::int16_t *x = dx.data, *y = dy.data;
  for (float& length : lengths) {
    std::int32_t square = 0;
    for (int channel = 0; channel < 3; ++channel, ++x, ++y) {
      square = std::max(square, std::int32_t{*x} * *x + std::int32_t{*y} * *y);
    }
    length = std::min(std::sqrt(float(square)), float(longest));
  }
}

}  // namespace hmt
