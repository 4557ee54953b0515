//! Data sets, generated scenes, the example scene.

mod chunks;
mod dataset;
mod procedural;
mod shipped_room;
mod train_data;
