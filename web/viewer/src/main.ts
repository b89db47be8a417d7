// main.ts - defines the element <rgs-view>. The page is this element alone.
// SPDX-License-Identifier: Apache-2.0
import { RgsView } from "./element.js";

if (!customElements.get("rgs-view")) customElements.define("rgs-view", RgsView);
