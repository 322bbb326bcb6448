"use strict";

// Shows openapi.json with Swagger UI. A file of its own, because the page's policy runs no inline
// script; validatorUrl is null, because the default asks a server on the internet.
SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  displayRequestDuration: true,
  tryItOutEnabled: true,
  validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis],
  layout: "BaseLayout",
});
