// @ts-check
/** Features that the service has only if its operator has installed their extra. The server fills them in. */

/** @type {{video: boolean, heif: boolean}} */
export const installed = /** @type {any} */ ("{{installed_extras}}");
