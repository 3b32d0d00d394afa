// Functions compiled for wide vector registers, too.
#pragma once

// A function with this attribute, and all that it calls, is compiled for processors with and
// without vectors of 256 bits; the version is chosen when the core is loaded. Results are
// identical. There is only one version if HMT_ONE_WIDTH is defined, as sanitizers need, and with
// clang++, which does not support this for templates.
#if defined(__x86_64__) && defined(__linux__) && !defined(HMT_ONE_WIDTH) && !defined(__clang__)
#define HMT_WIDE [[gnu::target_clones("avx2", "default"), gnu::flatten]]
#else
#define HMT_WIDE
#endif

// For functions that such functions call: they become part of each version.
#define HMT_INLINE [[gnu::always_inline]] inline
