"""Where gsplat has it: ``from gsplat.rendering import rasterization`` becomes ``from roofgs.rendering import rasterization``."""
# SPDX-License-Identifier: Apache-2.0
from ._rasterization import rasterization

__all__ = ["rasterization"]
