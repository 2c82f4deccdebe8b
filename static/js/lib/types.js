// Shapes of what travels between the pages and the server, as JSDoc types. The definition of a project is
// `core/project.py`; this is its mirror for the type checker. Nothing here runs.

/**
 * @typedef {[number, number]} Point
 *
 * @typedef {{id: number, ground_m: Point, frame_px: Point, enabled: boolean}} Correspondence
 * @typedef {{from_m: Point, to_m: Point, width_m: number}} Band
 * @typedef {"L1" | "L2" | "T1"} LineName
 * @typedef {Record<LineName, Band>} Lines
 * @typedef {object} Target
 * @property {string} name
 * @property {"lines" | "points"} kind
 * @property {number | null} height_m
 * @property {number | null} p1_p2_m
 * @property {Lines | null} lines
 * @property {Point[] | null} region_m
 * @property {string | null} relative_to
 *
 * @typedef {object} Project
 * @property {1} rooftrack
 * @property {string} name
 * @property {{video: string, cloud: string | null, lens: string | null, gps: GpsInput | null}} inputs
 * @property {{pixel_size_m: number, extent_m: [number, number, number, number] | null, ground_z_m: number | null}} orthoimage
 * @property {number} reference_frame
 * @property {Correspondence[]} correspondences
 * @property {Point[][]} moving_regions_px
 * @property {Target[]} targets
 * @property {[number, number][]} excluded_frames
 * @property {{pre_event: Point | null, event: Point | null, residual: Point | null}} intervals_s
 * @property {"geometric" | "paper"} method
 * @property {{filter: "none" | "high-pass", order: number, corner_hz: number}} drift
 *
 * @typedef {{file: string, time: string, x: string, y: string, at_m: Point | null}} GpsInput
 *
 * @typedef {"done" | "todo" | "warn" | "error" | "stale" | "running" | "unneeded"} StepStatus
 * @typedef {"inputs" | "orthoimage" | "correspondences" | "regions" | "track" | "review" | "drift" | "export"} StepName
 * @typedef {Record<StepName, {status: StepStatus, message: string}>} Steps
 *
 * @typedef {object} ProjectState
 * @property {string} id
 * @property {Project} project
 * @property {number} revision
 * @property {boolean} can_undo
 * @property {boolean} can_redo
 * @property {string | null} undo_label
 * @property {string | null} redo_label
 * @property {Steps} steps
 * @property {string[]} problems
 *
 * @typedef {object} Job
 * @property {string} id
 * @property {string} kind
 * @property {"running" | "done" | "failed" | "cancelled" | "interrupted"} state
 * @property {string} stage
 * @property {number} done
 * @property {number} total
 * @property {number | null} rate_per_s
 * @property {number | null} seconds_left
 * @property {string | null} message
 * @property {any} [result]
 *
 * @typedef {{west_m: number, north_m: number, pixel_size_m: number, width: number, height: number}} OrthoGrid
 */

export {};
