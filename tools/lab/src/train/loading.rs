//! Threads that make examples ahead of the training step.

use super::augment::Augmentation;
use super::ranks::Division;
use super::source::{Example, Source};
use super::{Error, Result};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// Interval at which [`Loader::take`] checks that a loading thread still runs.
const POLL_INTERVAL: Duration = Duration::from_secs(2);

/// Options of a [`Loader`].
#[derive(Clone, Copy, Debug)]
pub struct LoaderOptions {
    /// Augmentation of the examples.
    pub augmentation: Augmentation,
    /// Seed of the augmentation.
    pub seed: u64,
    /// Number of threads.
    pub workers: usize,
    /// Number of examples made ahead.
    pub ahead: usize,
    /// The examples that this process makes; it passes over the others.
    pub division: Division,
}

/// A queue of examples in the order of their indices, filled by separate threads.
pub struct Loader {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
    next: u64,
}

/// State shared by the loader and its threads.
struct Shared {
    source: Arc<dyn Source>,
    options: LoaderOptions,
    stop: AtomicBool,
    queue: Mutex<Queue>,
    changed: Condvar,
}

/// Examples between their start and their use.
struct Queue {
    /// First index that no thread has started.
    next_to_start: u64,
    /// First index that the training step has not taken.
    next_to_take: u64,
    /// Finished examples by index.
    done: BTreeMap<u64, Result<Option<Example>>>,
}

impl Shared {
    /// Locks the queue.
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for a change of the queue.
    fn wait<'a>(&self, queue: MutexGuard<'a, Queue>) -> MutexGuard<'a, Queue> {
        self.changed.wait(queue).unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes examples until the loader stops.
    fn work(&self) {
        loop {
            let mut queue = self.lock();
            let ahead = self.options.ahead.max(1) * self.options.division.ranks().count;
            while queue.next_to_start >= queue.next_to_take + ahead as u64
                && !self.stop.load(Ordering::Relaxed)
            {
                queue = self.wait(queue);
            }
            if self.stop.load(Ordering::Relaxed) {
                return;
            }
            let index = queue.next_to_start;
            queue.next_to_start += 1;
            drop(queue);
            let LoaderOptions { augmentation, seed, division, .. } = &self.options;
            let make = || self.source.example(index).map(|e| augmentation.apply(&e, *seed, index));
            let made = division.has(index).then(make).transpose();
            self.lock().done.insert(index, made);
            self.changed.notify_all();
        }
    }
}

impl Loader {
    /// Starts the threads at example `first`. Each has a pool of one thread, so that rendering does
    /// not queue before the step's own work.
    ///
    /// # Errors
    /// A thread that cannot be started.
    pub fn start(source: Arc<dyn Source>, options: LoaderOptions, first: u64) -> Result<Self> {
        let queue = Queue { next_to_start: first, next_to_take: first, done: BTreeMap::new() };
        let shared = Arc::new(Shared {
            source,
            options,
            stop: AtomicBool::new(false),
            queue: Mutex::new(queue),
            changed: Condvar::new(),
        });
        let mut threads = Vec::new();
        for i in 0..options.workers.max(1) {
            let shared = shared.clone();
            let body = move || {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
                match pool {
                    Ok(pool) => pool.install(|| shared.work()),
                    Err(_) => shared.work(),
                }
            };
            let thread = std::thread::Builder::new().name(format!("load-{i}")).spawn(body);
            threads.push(thread.map_err(|e| Error::value("threads", "a loading thread", e))?);
        }
        Ok(Self { shared, threads, next: first })
    }

    /// Returns the index of the next example.
    pub fn position(&self) -> u64 {
        self.next
    }

    /// Waits for the next example and returns it; `None` for an example of another process.
    ///
    /// # Errors
    /// An error of the source; loading threads that have ended.
    pub fn take(&mut self) -> Result<Option<Example>> {
        let mut queue = self.shared.lock();
        loop {
            if let Some(example) = queue.done.remove(&self.next) {
                self.next += 1;
                queue.next_to_take = self.next;
                drop(queue);
                self.shared.changed.notify_all();
                return example;
            }
            if self.threads.iter().all(JoinHandle::is_finished) {
                return Err(Error::value("loading", "a running loading thread", "none"));
            }
            let waited = self.shared.changed.wait_timeout(queue, POLL_INTERVAL);
            queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        {
            // The flag changes under the lock, so that no thread misses it between its test and its
            // wait.
            let _queue = self.shared.lock();
            self.shared.stop.store(true, Ordering::Relaxed);
        }
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // The panic of a thread is already reported.
            let _ = thread.join();
        }
    }
}
