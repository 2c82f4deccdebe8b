// Runs before the first paint (a plain script in <head>), so that a chosen theme never flashes the other one.
document.documentElement.dataset.theme = localStorage.getItem("rooftrack-theme") ?? "";
