"use strict";

// Shows openapi.json with Swagger UI. A separate file, because the page's policy forbids inline
// scripts. validatorUrl is null, because the default uses a server on the internet.
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
