// @ts-check
// The API's documentation, shown by Swagger UI (vendor/swagger-ui).
"use strict";

const { SwaggerUIBundle } = /** @type {any} */ (window);
SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#api",
  deepLinking: true,
  presets: [SwaggerUIBundle.presets.apis],
  layout: "BaseLayout",
  validatorUrl: null, // otherwise the document would be sent to a validator on the internet
});
