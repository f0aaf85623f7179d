"""Differentiable rasterization of fibers (Li et al. 2024, section 5.4 and 7.2): images with gradients of everything.

``curves`` makes the fibers from a fabric's parameters, ``visibility`` finds what each pixel sees and what shadows it,
``shade`` gives its color, ``edges`` lets gradients through where one thing covers another, ``renderer`` joins them.
"""
