// @ts-check
/** Statuses of jobs, and what users can do with a job in each. The server fills in its table of states. */

/** @type {{ titles: Record<string, string>, unfinished: string[], working: string[], stepping: string[], actions: { name: string, title: string, statuses: string[] }[] }} */
const states = /** @type {any} */ ("{{job_states}}");

/** Text to display for each status. */
export const titles = states.titles;
/** Return the fraction of its steps that a job has made; undefined unless it makes steps. @param {any} job */
export const stepFraction = ({ status, progress }) => (states.stepping.includes(status) && progress?.total ? progress.fraction : undefined);
export const UNFINISHED = new Set(states.unfinished), WORKING = new Set(states.working);

/**
 * Return the actions that a status allows: `POST /v1/jobs/{id}/{name}`, with the text of the button.
 * @param {string} status
 */
export const actionsOf = (status) => states.actions.filter((action) => action.statuses.includes(status));
