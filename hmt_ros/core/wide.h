// Functions compiled for wide vector registers, too.
#pragma once

// A function with this attribute is compiled for processors with vectors of 256 bits and for those
// without, with all that it calls; loading the core chooses. Its results are the same. It is
// compiled once where HMT_ONE_WIDTH is defined, as sanitizers want, and by clang++, which can not
// do that with templates.
#if defined(__x86_64__) && defined(__linux__) && !defined(HMT_ONE_WIDTH) && !defined(__clang__)
#define HMT_WIDE [[gnu::target_clones("avx2", "default"), gnu::flatten]]
#else
#define HMT_WIDE
#endif

// What such functions call: a part of each of their versions.
#define HMT_INLINE [[gnu::always_inline]] inline
