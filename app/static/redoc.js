"use strict";

// Shows openapi.json with Redoc. A separate file, because the page's policy forbids inline scripts.
Redoc.init("openapi.json", { disableSearch: false, nativeScrollbars: true }, document.getElementById("docs"));
