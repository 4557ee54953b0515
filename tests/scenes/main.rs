//! Tests of scenes: pose formats, pictures, the check of poses, navigation.

mod as_people_have_them;
mod check;
mod check_rendered;
mod foreign_cameras;
mod hostile_scenes;
mod lenses;
mod metrics;
mod navigation;
mod options;
mod other_paths;
mod other_programs;
mod photographs;
mod properties;
mod resize;
mod scene_formats;
mod scenes;
mod sources;
mod surveys;
