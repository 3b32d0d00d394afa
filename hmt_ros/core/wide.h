// Functions compiled for wide vector registers, too.
#pragma once

// A function with this attribute is compiled for processors with vectors of 512 bits, of 256 bits,
// and for those without; loading the core chooses. Its results are the same. Only what is inlined
// into it is compiled so. clang++ can not do that with templates.
#if defined(__x86_64__) && defined(__linux__) && !defined(__clang__)
#define HMT_WIDE [[gnu::target_clones("avx512f", "avx2", "default")]]
#else
#define HMT_WIDE
#endif

// What such functions call: a part of each of their versions.
#define HMT_INLINE [[gnu::always_inline]] inline
