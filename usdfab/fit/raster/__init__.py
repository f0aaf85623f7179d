"""Differentiable rasterization of fibers (Li et al. 2024, section 5.4 and 7.2): images with gradients of everything.

``curves`` makes the fibers from a fabric's parameters, in torch; ``visibility`` finds what each pixel sees and what
shadows it; ``hits`` says where rays meet fibers and ``shade`` gives their color; ``edges`` lets gradients through where
one thing covers another, which ``jumps`` and ``shadows`` find; ``renderer`` joins them.

What is done for each pixel are Numba kernels in double precision inside ``torch.autograd.Function``s, with derivatives
written out by hand: plain torch took three to five times as long, most of it to gather what kernels keep in
registers (``tests/benchmarks/bench_raster.py``).
"""
