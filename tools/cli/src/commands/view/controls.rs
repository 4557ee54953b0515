//! What keys, buttons and the wheel mean. No window and no camera: events in, wishes out.

use glam::Vec2;
use std::collections::BTreeSet;
use winit::event::{ElementState, MouseButton, MouseScrollDelta};
use winit::keyboard::KeyCode;

/// Pixels of a touchpad's scrolling that count as one step of a wheel.
const STEP_PX: f32 = 50.0;

/// What a key asks for, once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// Orbit or fly.
    Toggle,
    /// Back to the first camera.
    Reset,
    /// So many children a side of a pixel.
    Upscale(usize),
    /// A picture of the window.
    Save,
    /// The list of keys.
    Help,
    /// The end.
    Quit,
}

/// What a movement of the cursor drags, px, x right and y down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Drag {
    /// The camera's direction.
    Turn(Vec2),
    /// The camera's place.
    Pan(Vec2),
}

/// An axis of movement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Step {
    Right,
    Left,
    Up,
    Down,
    Forward,
    Back,
}

/// Which keys and buttons are down, and where the cursor is.
#[derive(Debug, Default)]
pub struct Controls {
    held: BTreeSet<Step>,
    /// Pressed since the last [`Controls::motion`]: a key that came and went between two
    /// frames moves in one of them.
    tapped: BTreeSet<Step>,
    shift: bool,
    left: bool,
    right: bool,
    cursor: Option<Vec2>,
}

fn step(key: KeyCode) -> Option<Step> {
    Some(match key {
        KeyCode::KeyW => Step::Forward,
        KeyCode::KeyS => Step::Back,
        KeyCode::KeyA => Step::Left,
        KeyCode::KeyD => Step::Right,
        KeyCode::KeyQ => Step::Down,
        KeyCode::KeyE => Step::Up,
        _ => return None,
    })
}

fn wish(key: KeyCode) -> Option<Wish> {
    Some(match key {
        KeyCode::KeyF => Wish::Toggle,
        KeyCode::KeyR => Wish::Reset,
        KeyCode::Digit1 | KeyCode::Numpad1 => Wish::Upscale(1),
        KeyCode::Digit2 | KeyCode::Numpad2 => Wish::Upscale(2),
        KeyCode::Digit4 | KeyCode::Numpad4 => Wish::Upscale(4),
        KeyCode::KeyP => Wish::Save,
        KeyCode::KeyH => Wish::Help,
        KeyCode::Escape => Wish::Quit,
        _ => return None,
    })
}

impl Controls {
    /// A key by its place on the keyboard, so that movement lies under the same fingers in
    /// every layout. `repeat`: the system says again what was said.
    pub fn key(&mut self, key: KeyCode, state: ElementState, repeat: bool) -> Option<Wish> {
        let down = state.is_pressed();
        if let Some(step) = step(key) {
            match down {
                true => {
                    self.held.insert(step);
                    self.tapped.insert(step);
                }
                false => {
                    self.held.remove(&step);
                }
            }
            return None;
        }
        wish(key).filter(|_| down && !repeat)
    }

    /// Whether a shift key is down.
    pub fn shift(&mut self, down: bool) {
        self.shift = down;
    }

    /// A button of the mouse.
    pub fn button(&mut self, button: MouseButton, state: ElementState) {
        match button {
            MouseButton::Left => self.left = state.is_pressed(),
            MouseButton::Right => self.right = state.is_pressed(),
            _ => {}
        }
    }

    /// The cursor's place, px; what it drags, if anything.
    pub fn cursor(&mut self, at: Vec2) -> Option<Drag> {
        let by = at - self.cursor.replace(at)?;
        match (self.left, self.right) {
            _ if by == Vec2::ZERO => None,
            (_, true) => Some(Drag::Pan(by)),
            (true, false) if self.shift => Some(Drag::Pan(by)),
            (true, false) => Some(Drag::Turn(by)),
            (false, false) => None,
        }
    }

    /// Steps forward of the wheel.
    pub fn wheel(delta: MouseScrollDelta) -> f32 {
        match delta {
            MouseScrollDelta::LineDelta(_, y) => y,
            MouseScrollDelta::PixelDelta(px) => px.y as f32 / STEP_PX,
        }
    }

    /// Whether there is something to move for.
    pub fn moving(&self) -> bool {
        !self.held.is_empty() || !self.tapped.is_empty()
    }

    /// Towards right, up and forward, each −1 to 1, and whether in haste: what the keys ask
    /// of the frame that is about to be drawn.
    pub fn motion(&mut self) -> ([f32; 3], bool) {
        let tapped = std::mem::take(&mut self.tapped);
        let on = |step: Step| f32::from(self.held.contains(&step) || tapped.contains(&step));
        let axis = |plus, minus| on(plus) - on(minus);
        let along = [
            axis(Step::Right, Step::Left),
            axis(Step::Up, Step::Down),
            axis(Step::Forward, Step::Back),
        ];
        (along, self.shift)
    }

    /// The window lost the keyboard: no release will be heard.
    pub fn release(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ElementState::{Pressed, Released};

    #[test]
    fn drags_by_button_and_shift() {
        let mut c = Controls::default();
        let px = Vec2::new(3.0, -2.0);
        assert_eq!(c.cursor(Vec2::ZERO), None);
        assert_eq!(c.cursor(px), None);
        c.button(MouseButton::Left, Pressed);
        assert_eq!(c.cursor(2.0 * px), Some(Drag::Turn(px)));
        assert_eq!(c.cursor(2.0 * px), None);
        c.shift(true);
        assert_eq!(c.cursor(3.0 * px), Some(Drag::Pan(px)));
        c.shift(false);
        c.button(MouseButton::Right, Pressed);
        assert_eq!(c.cursor(4.0 * px), Some(Drag::Pan(px)));
        c.button(MouseButton::Right, Released);
        assert_eq!(c.cursor(5.0 * px), Some(Drag::Turn(px)));
        c.release();
        assert_eq!(c.cursor(9.0 * px), None);
        assert_eq!(c.cursor(10.0 * px), None);
    }

    #[test]
    fn keys_move_while_they_are_held_and_once_where_they_were_tapped() {
        let mut c = Controls::default();
        c.key(KeyCode::KeyW, Pressed, false);
        c.key(KeyCode::KeyQ, Pressed, false);
        assert_eq!(c.motion(), ([0.0, -1.0, 1.0], false));
        c.key(KeyCode::KeyS, Pressed, false);
        c.shift(true);
        assert_eq!(c.motion(), ([0.0, -1.0, 0.0], true));
        for key in [KeyCode::KeyW, KeyCode::KeyQ, KeyCode::KeyS] {
            c.key(key, Released, false);
        }
        assert!(!c.moving());
        c.key(KeyCode::KeyA, Pressed, false);
        c.key(KeyCode::KeyA, Released, false);
        assert!(c.moving());
        assert_eq!(c.motion().0, [-1.0, 0.0, 0.0]);
        assert!(!c.moving() && c.motion().0 == [0.0; 3]);
        c.key(KeyCode::KeyE, Pressed, false);
        c.release();
        assert!(!c.moving());
    }

    #[test]
    fn wishes_come_once() {
        let mut c = Controls::default();
        assert_eq!(c.key(KeyCode::Digit4, Pressed, false), Some(Wish::Upscale(4)));
        assert_eq!(c.key(KeyCode::Digit4, Pressed, true), None);
        assert_eq!(c.key(KeyCode::Digit4, Released, false), None);
        assert_eq!(c.key(KeyCode::Escape, Pressed, false), Some(Wish::Quit));
        assert_eq!(c.key(KeyCode::KeyS, Pressed, false), None);
        assert_eq!(c.key(KeyCode::F12, Pressed, false), None);
    }

    #[test]
    fn a_touchpad_scrolls_as_a_wheel_does() {
        let px = winit::dpi::PhysicalPosition::new(0.0, -100.0);
        assert_eq!(Controls::wheel(MouseScrollDelta::PixelDelta(px)), -2.0);
        assert_eq!(Controls::wheel(MouseScrollDelta::LineDelta(5.0, 1.0)), 1.0);
    }
}
