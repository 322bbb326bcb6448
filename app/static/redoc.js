"use strict";

// Shows openapi.json with Redoc. A file of its own, because the page's policy runs no inline script.
Redoc.init("openapi.json", { disableSearch: false, nativeScrollbars: true }, document.getElementById("docs"));
