// @ts-check
/** Statuses of jobs, and what users can do with a job in each. The server fills in its table of states. */

/** @type {{ titles: Record<string, string>, unfinished: string[], cancelable: string[], retryable: string[] }} */
const states = /** @type {any} */ ("{{job_states}}");

/** Text to display for each status. */
export const titles = states.titles;
export const UNFINISHED = new Set(states.unfinished), CANCELABLE = new Set(states.cancelable), RETRYABLE = new Set(states.retryable);
