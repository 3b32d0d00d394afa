// Images as the core reads them.
#pragma once

#include "../arrays.h"

namespace hmt {

using Bytes = Array<const std::uint8_t, 2>;  // an image of one channel, or a mask
using Derivative = Array<const std::int16_t, 2>;

// The pixel inside (0 to size - 1) for one beyond a side: mirrored at the last pixel.
inline Index mirrored(Index i, Index size) {
  if (size == 1) return 0;
  while (i < 0 || i >= size) i = i < 0 ? -i : 2 * (size - 1) - i;
  return i;
}

}  // namespace hmt
