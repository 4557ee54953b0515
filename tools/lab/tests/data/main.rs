//! Tests of data sets, procedural rooms, the shipped example scene, and training on pictures from
//! disk.

mod chunks;
mod dataset;
mod procedural;
mod shipped_room;
mod train_data;
