// rgs.hpp - the whole format library.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "rgs/api.hpp"
#include "rgs/checksum.hpp"
#include "rgs/decode.hpp"
#include "rgs/encode.hpp"
#include "rgs/file.hpp"
#include "rgs/frame_content.hpp"
#include "rgs/layout.hpp"
#include "rgs/levels_writer.hpp"
#include "rgs/page.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/planes.hpp"
#include "rgs/quantize.hpp"
#include "rgs/result.hpp"
#include "rgs/scene_scan.hpp"
#include "rgs/scene_writer.hpp"
#include "rgs/spatial_order.hpp"
#include "rgs/splat_cloud.hpp"
#include "rgs/stored_values.hpp"
#include "rgs/version.hpp"
